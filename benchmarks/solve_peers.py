"""A peer's side of time_to_solve.py: it trains as shipped, in a process of its own, then its greedy policy is measured.

    python benchmarks/solve_peers.py "jaxmarl ippo" --steps 500000 --seed 0 --until SECONDS [--jaxmarl CHECKOUT]

On MPE's simple_spread with three agents and five actions, in the peer's environment. It prints the steps it has made
once it is trained, where the caller's clock stops, and then the final coverage 0.1: the share of landmarks that have an
agent within 0.1 after 25 steps, the mean over 320 episodes.
"""

import argparse
import json
import signal
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import peers

EPISODES, STEPS = 320, 25


def coverage(observations: Any) -> float:
    """The share of landmarks that are covered, from the last observations of episodes, [episode agent feature]."""
    offsets = np.asarray(observations)[..., 4:10].reshape(*observations.shape[:2], 3, 2)  # to the landmarks
    return float((np.linalg.norm(offsets, axis=-1).min(axis=1) < 0.1).mean())


def jaxmarl(program: str, checkout: str, steps: int, seed: int) -> None:
    """A baseline of JaxMARL: compiled with its steps, which are chosen before. A timer ends it."""
    import jax
    import jax.numpy as jnp
    from jaxmarl import make

    module, said, train = peers.jaxmarl_baseline(program, checkout, steps)
    trained = jax.block_until_ready(jax.jit(train)(jax.random.PRNGKey(seed)))["runner_state"]
    signal.setitimer(signal.ITIMER_REAL, 0)
    print(json.dumps({"steps": said["NUM_UPDATES"] * said["NUM_STEPS"] * said["NUM_ENVS"]}), flush=True)

    choose, memory = policy(program, module, said, trained)
    env = make(said["ENV_NAME"], **said["ENV_KWARGS"])
    reset, step = jax.jit(jax.vmap(env.reset)), jax.jit(jax.vmap(env.step_env))  # no reset in step_env
    keys = jax.random.split(jax.random.PRNGKey(seed + 1), EPISODES)
    seen, state = reset(keys)
    for _ in range(STEPS):
        rows = jnp.concatenate([seen[name] for name in env.agents])
        actions, memory = choose(rows, memory)
        actions = dict(zip(env.agents, actions.reshape(env.num_agents, EPISODES), strict=True))
        seen, state, *_ = step(keys, state, actions)
    print(json.dumps({"coverage": coverage(jnp.stack([seen[name] for name in env.agents], axis=1))}), flush=True)


def policy(program: str, module: Any, said: Any, trained: Any) -> tuple[Callable[[Any, Any], Any], Any]:
    """Greedy actions, from (observations, memory) to (actions, memory), a row per agent; and the first memory."""
    import jax
    import jax.numpy as jnp

    rows = 3 * EPISODES
    new = jnp.zeros((1, rows), dtype=bool)  # where an episode begins, which the first memory has said
    if program == "ippo":
        parameters = trained[0].params
        actor = module.ActorCritic(5, activation=said["ACTIVATION"])
        return jax.jit(lambda seen, memory: (actor.apply(parameters, seen)[0].mode(), memory)), None
    if program == "mappo":
        parameters = trained[0][0][0].params
        recurrent_actor = module.ActorRNN(5, config=said)

        def play(seen: Any, memory: Any) -> Any:
            memory, chances = recurrent_actor.apply(parameters, memory, (seen[None], new))
            return chances.mode()[0], memory

        return jax.jit(play), module.ScannedRNN.initialize_carry(rows, said["GRU_HIDDEN_DIM"])
    parameters = {"params": trained[0].params, "batch_stats": trained[0].batch_stats}
    shape = {"hidden_size": said["HIDDEN_SIZE"], "num_layers": said["NUM_LAYERS"], "norm_type": said["NORM_TYPE"]}
    values = module.QNetwork(5, **shape, dueling=False)
    names = jnp.repeat(jnp.eye(3), EPISODES, axis=0)  # its agents know which they are

    def best(seen: Any, memory: Any) -> Any:
        seen = jnp.concatenate([seen, names], axis=-1)
        if program == "vdn-pqn-ff":
            return values.apply(parameters, seen).argmax(-1), memory
        memory, found = values.apply(parameters, memory, seen[None], new)
        return found[0].argmax(-1), memory

    if program == "vdn-pqn-ff":
        return jax.jit(best), None
    return jax.jit(best), module.ScannedRNN.initialize_carry(said["HIDDEN_SIZE"], rows)


class Until(peers.Callback):
    """Ends BenchMARL's training in time, and measures its policy. (Here, because it pickles its callbacks.)"""

    def __init__(self, until: float) -> None:
        super().__init__()
        self.until = until

    def on_train_end(self, training_td: Any, group: str) -> None:
        if time.time() < self.until:
            return
        print(json.dumps({"steps": self.experiment.total_frames}), flush=True)
        found = play_benchmarl(self.experiment.policy, group, EPISODES, STEPS)
        print(json.dumps({"coverage": found["coverage"]}), flush=True)
        raise peers.Enough


def play_benchmarl(policy: Any, group: str, episodes: int, steps: int) -> dict[str, float]:
    """Greedy episodes of a policy of BenchMARL in PettingZoo's simple_spread: an agent's return, and coverage."""
    import torch
    from pettingzoo.mpe import simple_spread_v3
    from tensordict import TensorDict
    from torchrl.envs.utils import ExplorationType, set_exploration_type

    def batch(seen: list[dict[str, Any]]) -> Any:
        return torch.tensor(np.array([list(each.values()) for each in seen]))

    envs = [simple_spread_v3.parallel_env(max_cycles=steps) for _ in range(episodes)]
    seen = [env.reset(seed=number)[0] for number, env in enumerate(envs)]
    earned = 0.0
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        for _ in range(steps):
            given = TensorDict({group: TensorDict({"observation": batch(seen)}, [episodes, 3])}, [episodes])
            actions = policy(given)[group, "action"].tolist()
            pairs = zip(envs, actions, strict=True)
            after = [env.step(dict(zip(env.agents, chosen, strict=True))) for env, chosen in pairs]
            seen = [it[0] for it in after]
            earned += float(np.mean([list(it[1].values()) for it in after]))
    return {"return": earned, "coverage": coverage(batch(seen))}


def benchmarl(program: str, seed: int, until: float) -> None:
    """BenchMARL on PettingZoo's simple_spread: it trains until then."""
    from benchmarl.environments import PettingZooTask

    task = PettingZooTask.SIMPLE_SPREAD.get_from_yaml()
    task.config["max_cycles"] = STEPS
    peers.benchmarl_run(task, program, Until(until), seed, prefer_continuous_actions=False)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("peer")
    parser.add_argument("--steps", type=int, required=True)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--until", type=float, required=True, help="Unix time that training must end at")
    parser.add_argument("--jaxmarl", help="a checkout of the JaxMARL repository, for its baselines")
    asked = parser.parse_args()
    library, program = asked.peer.split()
    if library == "jaxmarl":
        signal.setitimer(signal.ITIMER_REAL, max(asked.until - time.time(), 0.001))
        jaxmarl(program, asked.jaxmarl, asked.steps, asked.seed)
    else:
        benchmarl(program, asked.seed, asked.until)


if __name__ == "__main__":
    main()
