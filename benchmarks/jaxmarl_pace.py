"""JaxMARL's environments through our loop, beside its own: random actions, environment steps a second of CPU time.

    python benchmarks/jaxmarl_pace.py [--json]    in an environment that has JaxMARL

64 copies play 500 steps; both begin a new episode where one has ended. Medians of five turns.
"""

import json
import statistics
import sys
import time
from collections.abc import Callable
from typing import Any

import jax
import jaxmarl

from gacrl import rollout, tasks
from gacrl.evaluation.references import random
from gacrl.tasks import own
from gacrl.training.devices import prepare_jax

ENVIRONMENTS = ("MPE_simple_spread_v3", "HeuristicEnemySMAX", "overcooked")
COPIES, STEPS, TURNS = 64, 500, 5


def theirs(env: Any, num_actions: int) -> Callable[[Any], Any]:
    """Return its own loop: the step that resets, mapped."""

    def act(key: Any) -> dict[str, Any]:
        keys = jax.random.split(key, len(env.agents))
        return {
            agent: jax.random.randint(k, (), 0, num_actions) for agent, k in zip(env.agents, keys, strict=True)
        }

    def play(key: Any) -> Any:
        def one_step(state: Any, key: Any) -> tuple[Any, Any]:
            keys = jax.random.split(key, (COPIES, 2))
            actions = jax.vmap(act)(keys[:, 0])
            _, state, rewards, _, _ = jax.vmap(env.step)(keys[:, 1], state, actions)
            return state, sum(rewards[agent].sum() for agent in env.agents)

        _, state = jax.vmap(env.reset)(jax.random.split(key, COPIES))
        return jax.lax.scan(one_step, state, jax.random.split(key, STEPS))[1].sum()

    return jax.jit(play)


def ours(env: Any) -> Callable[[Any], Any]:
    """Return the loop of training and evaluation."""
    actor = random(env)

    def play(key: Any) -> Any:
        def one_step(carry: Any, key: Any) -> tuple[Any, Any]:
            carry, transition = rollout.step(env, actor.policy, (), (), carry, key)
            return carry, transition.reward.sum()

        carry = rollout.start(env, (), (), key, COPIES)
        return jax.lax.scan(one_step, carry, jax.random.split(key, STEPS))[1].sum()

    return jax.jit(play)


def measure(name: str) -> dict[str, float]:
    """Return both paces; they take turns."""
    task, settings = own.bring(f"jaxmarl:{name}")
    env = tasks.find(task).make(settings)
    plays = {"theirs": theirs(jaxmarl.make(name), env.num_actions), "ours": ours(env)}
    found: dict[str, list[float]] = {who: [] for who in plays}
    for turn in range(TURNS + 1):
        for who, play in plays.items():
            begun = time.process_time()
            play(jax.random.key(turn)).block_until_ready()
            if turn:  # the first one compiles
                found[who].append(COPIES * STEPS / (time.process_time() - begun))
    return {who: statistics.median(turns) for who, turns in found.items()}


if __name__ == "__main__":
    prepare_jax()
    measured = {name: measure(name) for name in ENVIRONMENTS}
    for name, paces in measured.items():
        print(name, {who: round(pace) for who, pace in paces.items()})
    if "--json" in sys.argv:
        print(json.dumps({"ratio": {"jaxmarl": {name: p["ours"] / p["theirs"] for name, p in measured.items()}}}))
