"""Scripted policies beside a study: many episodes, played once for all difficulties, kept in the study's folder.

Random's moves do not depend on θ or the local ratio. One set of episodes is therefore scored at every difficulty,
and only the scores that depend on it are held more than once. D difficulties, E episodes.
"""

import json
import zipfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from gacrl import tasks
from gacrl.config import files as configuration
from gacrl.config.run import RunConfig
from gacrl.evaluation.evaluate import stream_key
from gacrl.evaluation.references import scripted_program
from gacrl.experiments.paper.tables import SCRIPTED
from gacrl.replacing import replaced

EPISODES = 20_000
"""Of each scripted policy: with 320 a printed mean of 50 falls outside random's interval by noise in 26 % of cases."""
_AT_ONCE = 2_000
FILE = "references.npz"

Difficulty = tuple[float, float]
"""Local ratio and θ."""
Episodes = Mapping[str, Float[np.ndarray, " E"]]


def difficulty(numbers: Mapping[str, float]) -> Difficulty:
    """Return the difficulty in a row of `metrics.jsonl`."""
    return float(numbers["local_ratio"]), float(numbers["coverage_threshold"])


def played(
    folder: Path,
    config: RunConfig,
    difficulties: Sequence[Difficulty],
    say: Callable[[str], None] = lambda sentence: None,
) -> dict[str, dict[Difficulty, Episodes]]:
    """Return every metric of every episode, by policy and difficulty: from the folder, or played and written there.

    A file of another task, other difficulties or fewer episodes is replaced, and so is one that is damaged.
    """
    task = configuration.to_dict(config)["env"] | {"reward": "paper"}  # one program for all columns
    asked = json.dumps([task, sorted(set(difficulties)), EPISODES, _AT_ONCE], sort_keys=True)
    held = _read(folder / FILE, asked)
    if held is None:
        say(f"playing {', '.join(SCRIPTED)}: {EPISODES:,} episodes at {len(set(difficulties))} difficulties")
        held = {name: _play(name, config, sorted(set(difficulties))) for name in SCRIPTED}
        _write(folder / FILE, asked, held)
    order = {at: k for k, at in enumerate(sorted(set(difficulties)))}
    return {
        name: {at: {m: v[k if len(v) > 1 else 0] for m, v in metrics.items()} for at, k in order.items()}
        for name, metrics in held.items()
    }


def _play(name: str, config: RunConfig, difficulties: Sequence[Difficulty]) -> dict[str, np.ndarray]:
    """Each metric [D, E], or [1, E] where the difficulty does not matter."""
    program = _program(name, config.task, replace(config.env, reward="paper"))
    levels = jnp.asarray(difficulties)
    keys = jax.random.split(stream_key("report"), max(EPISODES // _AT_ONCE, 1))
    parts = [jax.device_get(program(levels, key)) for key in keys]
    whole = {metric: np.concatenate([part[metric] for part in parts], 1) for metric in parts[0]}
    return {metric: values[:1] if (values == values[0]).all() else values for metric, values in whole.items()}


@cache
def _program(name: str, task: str, settings: Any) -> Callable[..., dict[str, jax.Array]]:
    """The metrics of a policy's episodes at each of [D, 2] difficulties, compiled once a process."""
    found = tasks.find(task)
    params = found.numbers(settings, found.make(settings))
    play = scripted_program(name, task, settings, _AT_ONCE)

    def at(level: jax.Array, key: jax.Array) -> dict[str, jax.Array]:
        return play(params._replace(local_ratio=level[0], coverage_threshold=level[1]), key)

    return jax.jit(jax.vmap(at, in_axes=(0, None)))


def _read(file: Path, asked: str) -> dict[str, dict[str, np.ndarray]] | None:
    try:
        with file.open("rb") as opened, np.load(opened, allow_pickle=False) as held:
            if str(held["asked"]) != asked:
                return None
            names = [name.split("/") for name in held.files if "/" in name]
            found: dict[str, dict[str, np.ndarray]] = {who: {} for who, _ in names}
            for who, metric in names:
                found[who][metric] = held[f"{who}/{metric}"]
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error):
        return None
    return found if set(found) == set(SCRIPTED) else None


def _write(file: Path, asked: str, held: Mapping[str, Mapping[str, np.ndarray]]) -> None:
    arrays = {f"{who}/{metric}": values for who, metrics in held.items() for metric, values in metrics.items()}
    with replaced(file) as opened:
        np.savez_compressed(opened, asked=np.array(asked), **arrays)  # pyright: ignore[reportArgumentType]
