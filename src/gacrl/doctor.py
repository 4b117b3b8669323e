"""Does this machine work? Devices, the physics beside the installed MPE2, and what algorithms learn."""

import platform
from collections.abc import Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gacrl import config, envs
from gacrl.config import EnvConfig
from gacrl.envs import scripted
from gacrl.envs.probes import BEST_RETURN
from gacrl.evaluation import mpe2
from gacrl.evaluation.evaluate import evaluate, stream_key
from gacrl.training.probing import probe_algorithm
from gacrl.training.session import versions

PROBE_UPDATES = 3_000
"""Updates on each probe: enough for the paper's learning rate with room to spare."""


BEYOND = {"gacrl_paper": ("message",)}
"""Probes that an algorithm does not pass, and why docs/algorithm.md says so."""


class Finding(NamedTuple):
    what: str
    good: bool
    detail: str


def examine() -> Iterator[Finding]:
    """Look at one thing after the other; none of it takes longer than half a minute."""
    found = versions()
    yield Finding("versions", True, ", ".join(f"{name} {version}" for name, version in found.items()))
    devices = jax.local_devices()
    yield Finding("devices", True, f"{len(devices)} × {devices[0].device_kind} on {platform.machine()}")
    yield _same_world()
    for name in config.PRESETS:
        yield from _learns(name)


def _same_world() -> Finding:
    """The oracle's return in our environment and in the real MPE2, on each one's own starts."""
    env = envs.make(EnvConfig())
    policy, memory = scripted.make("oracle", env)
    key, episodes = stream_key("monitor"), 64
    ours = jax.jit(lambda: evaluate(env, policy, memory, env.default_params(), key, episodes))()
    theirs = mpe2.evaluate(env, policy, memory, key, episodes)
    here, there = np.asarray(ours["return_agent_mean"]), theirs["return_agent_mean"]
    error = np.hypot(here.std(), there.std()) / np.sqrt(episodes)
    apart = abs(here.mean() - there.mean())
    return Finding(
        "environment",
        bool(apart < 4 * error),
        f"the oracle's return is {here.mean():.2f} here and {there.mean():.2f} in MPE2 "
        f"({apart / error:.1f} standard errors apart)",
    )


def _learns(preset: str) -> Iterator[Finding]:
    """The probes in which acting matters, one finding each; those beyond an algorithm are only reported."""
    algorithm = config.preset(preset).algorithm
    result = probe_algorithm(algorithm, PROBE_UPDATES)
    for probe, best in BEST_RETURN.items():
        reached = result.returns[probe]
        beyond = probe in BEYOND.get(algorithm.name, ())
        yield Finding(
            f"{preset} on probe '{probe}'",
            beyond or bool(jnp.isclose(reached, best)),
            f"return {reached:.2f} of {best:.2f}" + " (not within this algorithm's reach)" * beyond,
        )
