"""MPE2 through the trainer of environments that live in Python, beside a plain loop with the same compiled policy.

    python benchmarks/host.py [--json] [MODULE …]

Prints environment steps a second (of CPU time) of one seed: a loop that only acts, the trainer where it only acts, and
the trainer with learning. Each is the median of five turns.
"""

import json
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from importlib import import_module

import jax
import numpy as np

import gacrl
from gacrl.tasks import own
from gacrl.training import build
from gacrl.training.devices import one_seed, prepare_jax
from gacrl.types import Observation

SECONDS, TURNS = 1.5, 5


def paces(plays: dict[str, Callable[[], int]]) -> dict[str, float]:
    """Return steps a second of each, the median of several turns: they take turns, so that a busy moment hits all."""
    found: dict[str, list[float]] = {name: [] for name in plays}
    for _ in range(TURNS):
        for name, play in plays.items():
            begun, steps = time.process_time(), 0
            while time.process_time() - begun < SECONDS:
                steps += play()
            found[name].append(steps / (time.process_time() - begun))
    return {name: statistics.median(turns) for name, turns in found.items()}


def plain(module: str, decide: Callable, carry, left, key, num_envs: int, num_steps: int) -> Callable[[], int]:
    """Return a loop as one writes it by hand: dictionaries in, a policy, dictionaries out."""
    envs = [import_module(module).parallel_env() for _ in range(num_envs)]
    seen = [list(env.reset(seed=k)[0].values()) for k, env in enumerate(envs)]
    like: Observation = carry.observation
    size = like.features.shape[-1]
    names = envs[0].possible_agents

    def play() -> int:
        now = carry
        for step in range(num_steps):
            features = np.zeros((num_envs, len(names), size), np.float32)
            for k, rows in enumerate(seen):
                for i, row in enumerate(rows):
                    features[k, i, : row.size] = row
            now = now._replace(observation=like._replace(features=features))
            now, decision = decide(now, left, key, np.int32(step))
            actions = np.asarray(decision.action)
            for k, env in enumerate(envs):
                observations, _, terminated, truncated, _ = env.step(
                    dict(zip(names, actions[k].tolist(), strict=True))
                )
                if any(terminated.values()) or any(truncated.values()):
                    observations, _ = env.reset()
                seen[k] = list(observations.values())
        return num_envs * num_steps

    return play


def measure(module: str, preset: str = "ippo") -> dict[str, float]:
    """Return the three paces."""
    name, settings = own.bring(f"pettingzoo:{module}")
    config = replace(gacrl.preset(preset), task=name, env=settings)
    trainer = build.make_trainer(config)
    state = trainer.init((0,))
    trainer.compiled(state, 1)
    state, _ = trainer.chunk(state, 1)
    member, stage = one_seed(state, 0), trainer._standing(0)
    acting, count = trainer.algorithm.acting(member.learner), (config.training.num_envs, config.training.num_steps)

    def decide(*given):
        return trainer._decide(acting, *given)

    def acts() -> int:
        jax.block_until_ready(trainer._play(stage, member))
        return count[0] * count[1]

    def learns() -> int:
        nonlocal state
        state, _ = trainer.chunk(state, 1)
        jax.block_until_ready(state)
        return count[0] * count[1]

    carry = stage.carry(member.carry)
    by_hand = plain(module, decide, carry, stage.left, member.key, *count)
    return paces({"plain loop": by_hand, "acting": acts, "learning": learns})


if __name__ == "__main__":
    prepare_jax()
    words = [word for word in sys.argv[1:] if word != "--json"]
    found = {name: measure(name) for name in words or ["mpe2.simple_spread_v3"]}
    for name, measured in found.items():
        print(name, {what: round(value) for what, value in measured.items()})
    if "--json" in sys.argv:
        ratios = {name: measured["acting"] / measured["plain loop"] for name, measured in found.items()}
        print(json.dumps({"ratio": {"plain loop": ratios}}))
