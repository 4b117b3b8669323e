"""Does this machine work? Devices, the physics beside the installed MPE2, and what algorithms learn."""

import platform
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gacrl import tasks
from gacrl.adapters import mpe2
from gacrl.config import presets
from gacrl.config.algorithms import AlgorithmConfig, GacrlConfig, GacrlPaperConfig, PpoConfig
from gacrl.envs.probes import BEST_RETURN
from gacrl.evaluation import references
from gacrl.evaluation.evaluate import evaluate, stream_key
from gacrl.networks.communication import kind_of
from gacrl.training.probing import probe_algorithm
from gacrl.versions import versions

BEYOND = {
    # Its messages are made from the latent alone, which the printed weight of the KL term keeps empty.
    "paper": ("message",),
    # Their agents do not talk.
    "qmix": ("message",),
    "vdn": ("message",),
    "iql": ("message",),
    "mappo": ("message",),
    "ippo": ("message",),
}
"""Probes that a preset's agents cannot pass."""


class Trial(NamedTuple):
    """How long an algorithm is trained on the probes: enough for each of three seeds."""

    algorithm: AlgorithmConfig
    num_updates: int
    num_envs: int = 1


class Finding(NamedTuple):
    """What a check has found."""

    what: str
    good: bool
    detail: str


class Check(NamedTuple):
    """One thing to look at."""

    what: str
    work: float
    """How long it takes beside the others."""
    look: Callable[[], Iterator[Finding]]


def checks() -> list[Check]:
    """List what there is to look at, the quickest first; none of it takes longer than half a minute."""
    found = [
        Check("versions", 0.0, _versions),
        Check("devices", 0.0, _devices),
        Check("the environment beside MPE2's", 1.0, _same_world),
    ]
    seen: list[Trial] = []
    for name in presets.PRESETS:
        if name.startswith("graph-"):  # learners of the others; what they see more shows only in space
            continue
        asked = trial(presets.preset(name).algorithm)
        if asked not in seen:  # presets may differ by their task alone, or by how far agents see
            found.append(Check(f"{name} on the probes", 1.0, partial(_learns, name, asked)))
        seen.append(asked)
    return found


def _versions() -> Iterator[Finding]:
    yield Finding("versions", True, ", ".join(f"{name} {version}" for name, version in versions().items()))


def _devices() -> Iterator[Finding]:
    devices = jax.local_devices()
    yield Finding("devices", True, f"{len(devices)} × {devices[0].device_kind} on {platform.machine()}")


def _same_world() -> Iterator[Finding]:
    """The oracle's return in our environment and in the real MPE2, on each one's own starts."""
    task = tasks.find(tasks.DEFAULT)
    env = task.make(tasks.default_settings(tasks.DEFAULT))
    policy, memory = references.actor(task, "oracle", env)
    key, episodes = stream_key("monitor"), 64
    ours = jax.jit(lambda: evaluate(env, policy, memory, env.default_params(), key, episodes))()
    theirs = mpe2.evaluate(env, policy, memory, key, episodes)
    here, there = np.asarray(ours["return_agent_mean"]), theirs["return_agent_mean"]
    error = np.hypot(here.std(), there.std()) / np.sqrt(episodes)
    apart = abs(here.mean() - there.mean())
    yield Finding(
        "environment",
        bool(apart < 4 * error),
        f"the oracle's return is {here.mean():.2f} here and {there.mean():.2f} in MPE2 "
        f"({apart / error:.1f} standard errors apart)",
    )


def trial(algorithm: AlgorithmConfig) -> Trial:
    """Make the algorithm as it is taken to the probes: for tiny tasks its network is narrow, its windows are short, and
    it learns fast, from the first step on."""
    if isinstance(algorithm, GacrlPaperConfig):
        return Trial(algorithm, 1_500)
    network = replace(algorithm.network, width=32, nearest_landmarks=None, nearest_agents=None)
    if isinstance(algorithm, PpoConfig):
        return Trial(replace(algorithm, network=network), 40, 128)
    algorithm = replace(algorithm, network=network, learning_starts=0, updates=8)
    if not isinstance(algorithm, GacrlConfig):
        window = min(algorithm.sequence_length, 2)
        return Trial(replace(algorithm, sequence_length=window, batch_size=32, learning_rate=5e-3), 60, 64)
    return Trial(replace(algorithm, network=network, batch_size=128, learning_rate=2e-3), 150, 64)


def _learns(preset: str, asked: Trial) -> Iterator[Finding]:
    """The probes in which acting matters, one finding each; those beyond an algorithm are only reported.

    For agents that hear a step later what is said, the late probe of messages is theirs.
    """
    network = getattr(asked.algorithm, "network", None)
    late = network is not None and kind_of(network).heard_late
    probes = ("action", "both", "late_message" if late else "message")
    result = probe_algorithm(*asked, probes=probes)
    for probe in probes:
        reached, best = result.returns[probe], BEST_RETURN[probe]
        beyond = probe in BEYOND.get(preset, ())
        yield Finding(
            f"{preset} on probe '{probe}'",
            beyond or bool(jnp.isclose(reached, best)),
            f"return {reached:.2f} of {best:.2f}" + " (not within its reach)" * beyond,
        )
