"""Environment steps a second: `spread` beside JaxMARL's MPE_simple_spread_v3 and VMAS's simple_spread.

    python benchmarks/environment.py [--rounds 5] [--core 0] [--json]
    python benchmarks/environment.py --agents 3 10 30 100 300        # cost of a step against the size of the team
    python benchmarks/environment.py --task reference speaker_listener   # other tasks, of ours and of JaxMARL's MPE

Random actions, observations, rewards and the beginning of new episodes (25 steps) included. JaxMARL and this library
run inside one compiled `lax.scan`, their actions drawn in the same program; VMAS in its own eager loop. Every step
writes the observations of all agents, as a policy would read them, and adds up the rewards. VMAS's task is another
one (14 observations).
"""

import argparse
import functools
import json
import sys
import time
from collections.abc import Callable
from typing import Any

import peers

SIZES = (1, 32, 1_024, 16_384)
SECONDS = 0.3
"""Of a measurement, about."""
HORIZON = 25
JAXMARL = {
    "spread": "MPE_simple_spread_v3",
    "reference": "MPE_simple_reference_v3",
    "speaker_listener": "MPE_simple_speaker_listener_v4",
}
"""Its names of our tasks. Those with utterances are played with utterance actions, as it has them."""


def timed(run: Callable[[Any, int], Any], state: Any) -> Callable[[], float]:
    """Seconds of one step, from measurements of so many steps that they take about `SECONDS`."""
    begun = time.process_time()
    state = run(state, HORIZON)  # compiles
    begun = time.process_time()
    state = run(state, HORIZON)
    steps = HORIZON * max(1, round(SECONDS / max(time.process_time() - begun, 1e-4)))
    state = run(state, steps)

    def measure() -> float:
        nonlocal state
        begun = time.process_time()
        state = run(state, steps)
        return (time.process_time() - begun) / steps

    return measure


def scanned(step: Callable[..., Any], draw: Callable[..., Any]) -> Callable[[Any, int], Any]:
    """`step(state, total, action, key)` T times in one compiled program, after drawing T actions."""
    import jax

    @functools.partial(jax.jit, static_argnums=1)
    def run(loop: Any, steps: int) -> Any:
        (state, total), key = loop
        action_key, step_key, key = jax.random.split(key, 3)
        inputs = (draw(action_key, steps), jax.random.split(step_key, steps))
        after, _ = jax.lax.scan(lambda loop, drawn: (step(*loop, *drawn), None), (state, total), inputs)
        return after, key

    return lambda loop, steps: jax.block_until_ready(run(loop, steps))


@functools.cache
def ours(num_envs: int, agents: int = 3, nearest: int | None = None, task: str = "spread") -> Callable[[], float]:
    import jax
    import jax.numpy as jnp

    import gacrl
    from gacrl.envs import copies

    size = {"num_agents": agents, "num_agent_neighbors": nearest, "num_landmark_neighbors": nearest}
    env: Any = gacrl.make_env(task, **(size if task == "spread" else {"talk": "actions"}))
    params = env.default_params()
    mask = env.reset(jax.random.key(0), params)[1].action_mask
    possible = jnp.argsort(~mask, axis=1)  # of each agent, first what it can do

    def draw(key: Any, steps: int) -> Any:
        drawn = jax.random.bits(key, (steps, num_envs, env.num_agents))
        if task == "spread":
            return (drawn % 5).astype(jnp.int32)
        return possible[jnp.arange(env.num_agents), drawn % mask.sum(1)].astype(jnp.int32)

    def step(state: Any, total: Any, action: Any, key: Any) -> Any:
        state, observation, after = copies.step(env, params, state[0], action, key)
        return (state, observation.features), total + after.reward.sum(1)

    state, observation = copies.reset(env, params, jax.random.split(jax.random.key(0), num_envs))
    start = ((state, observation.features), jnp.zeros(num_envs)), jax.random.key(1)
    return timed(scanned(step, draw), start)


@functools.cache
def jaxmarl(num_envs: int, task: str = "spread") -> Callable[[], float]:
    import jax
    import jax.numpy as jnp
    from jaxmarl import make

    env = make(JAXMARL[task])
    agents = len(env.agents)
    possible = jnp.array([env.action_spaces[name].n for name in env.agents])[:, None]

    def draw(key: Any, steps: int) -> Any:
        drawn = jax.random.bits(key, (steps, agents, num_envs))
        return (drawn % (5 if task == "spread" else possible)).astype(jnp.int32)

    def step(state: Any, total: Any, action: Any, key: Any) -> Any:
        actions = {name: action[i] for i, name in enumerate(env.agents)}
        keys = jax.random.split(key, num_envs)
        observation, state, reward, _, _ = jax.vmap(env.step)(keys, state[0], actions)
        return (state, observation), total + sum(reward.values())

    observation, state = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), num_envs))
    start = ((state, observation), jnp.zeros(num_envs)), jax.random.key(1)
    return timed(scanned(step, draw), start)


@functools.cache
def vmas(num_envs: int) -> Callable[[], float]:
    import torch
    import vmas

    torch.set_num_threads(1)
    env = vmas.make_env(
        "simple_spread", num_envs=num_envs, n_agents=3, continuous_actions=False, max_steps=HORIZON, seed=0
    )

    def run(total: Any, steps: int) -> Any:
        for _ in range(steps):
            actions = [torch.randint(5, (num_envs,)) for _ in env.agents]
            _, rewards, done, _ = env.step(actions)
            total = total + sum(rewards)
            if done.any():  # the time limit: all at once
                env.reset()
        return total

    env.reset()
    return timed(run, torch.zeros(num_envs))


def compare(rounds: int, core: int) -> dict[str, dict[str, list[float]]]:
    """How many times as fast as each peer, per number of environments and round."""
    interpreters = {"jaxmarl": peers.python_of("jaxmarl"), "vmas": peers.python_of("benchmarl")}
    ratios: dict[str, dict[str, list[float]]] = {}
    us = peers.Side("ours", sys.executable, __file__, core)
    for name, python in interpreters.items():
        if python is None:
            continue
        peer = peers.Side(name, python, __file__, core)
        for size in SIZES:
            pairs = [(us.ask(num_envs=size), peer.ask(num_envs=size)) for _ in range(rounds)]
            found = [(mine, theirs) for mine, theirs in pairs if mine and theirs]
            if len(found) < rounds:
                break
            ratios.setdefault(name, {})[str(size)] = [theirs / mine for mine, theirs in found]
            mine, theirs = (peers.spread([size / pair[k] for pair in found]) for k in (0, 1))
            print(f"{size:6,} environments: ours {mine} steps/s, {name} {theirs}", flush=True)
            print(f"       {peers.spread(ratios[name][str(size)])} times as fast as {name}", flush=True)
        peer.close()
    us.close()
    return ratios


def of_tasks(names: list[str], rounds: int, core: int) -> dict[str, dict[str, list[float]]]:
    """How many times as fast as JaxMARL in other tasks, per number of environments and round; {} without JaxMARL."""
    python = peers.python_of("jaxmarl")
    us = peers.Side("ours", sys.executable, __file__, core)
    peer = None if python is None else peers.Side("jaxmarl", python, __file__, core)
    ratios: dict[str, dict[str, list[float]]] = {}
    for name in names:
        for size in SIZES[:3]:
            pairs = [
                [side.ask(num_envs=size, task=name) if side else None for side in (us, peer)]
                for _ in range(rounds)
            ]
            mine, theirs = ([size / took for pair in pairs if (took := pair[k])] for k in (0, 1))
            print(f"{name:16} {size:6,} environments: ours {peers.spread(mine)} steps/s", flush=True)
            if len(theirs) == len(mine) == rounds:
                found = [us / them for us, them in zip(mine, theirs, strict=True)]
                ratios.setdefault(name, {})[str(size)] = found
                print(f"{'':16} jaxmarl {peers.spread(theirs)}; {peers.spread(found)} times as fast", flush=True)
    for side in (us, peer):
        if side is not None:
            side.close()
    return ratios


def against_team_size(sizes: list[int], core: int) -> None:
    """Microseconds of a step of one environment, seeing everyone and only the four nearest."""
    us = peers.Side("ours", sys.executable, __file__, core)
    print("agents  environments  sees all, µs  per pair, ns  four nearest, µs")
    for agents in sizes:
        num_envs = max(1, min(32, 3_000 // agents))
        asked = [{"agents": agents, "num_envs": num_envs}, {"agents": agents, "num_envs": num_envs, "nearest": 4}]
        every, nearest = (min(us.ask(**one) or 0.0 for _ in range(3)) / num_envs * 1e6 for one in asked)
        print(f"{agents:6}{num_envs:14}{every:14.2f}{1e3 * every / agents**2:14.2f}{nearest:18.2f}", flush=True)
    us.close()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5, help="turns of each side, per size")
    parser.add_argument("--core", type=int, default=0, help="the core that all sides are pinned to")
    parser.add_argument("--agents", type=int, nargs="+", help="instead: ours alone, against the number of agents")
    parser.add_argument("--task", nargs="+", choices=JAXMARL, help="instead: these tasks, ours and JaxMARL's")
    parser.add_argument(
        "--json", action="store_true", help="end with one line: {ratio: {peer or task: {size: value}}}"
    )
    parser.add_argument("--serve", help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.serve:
        side = {"ours": ours, "jaxmarl": jaxmarl, "vmas": vmas}[asked.serve]
        peers.serve(lambda **request: side(**request)())
    elif asked.agents:
        against_team_size(asked.agents, asked.core)
    else:
        measure = functools.partial(of_tasks, asked.task) if asked.task else compare
        ratios = measure(asked.rounds, asked.core)
        if asked.json:
            print(json.dumps(peers.summary(ratios)))


if __name__ == "__main__":
    main()
