"""Every algorithm's run, interrupted and gone on with, ends with the bits of one that never was; and so does one again."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from conftest import assert_nearly_same

from gacrl.config import presets
from gacrl.config.presets import PRESETS
from gacrl.config.run import EvaluationConfig, RunConfig, TrainingConfig
from gacrl.training import build, session
from gacrl.training.session import Ended
from gacrl.training.watching import Watcher

pytestmark = pytest.mark.usefixtures("one_trainer")

TIMES = ("steps_per_second", "compile_seconds", "wall_seconds")
FAMILIES = {"mappo": [], "vdn": [pytest.mark.slow]}
"""One of each learner; the paper's is in test_resume.py, and `make soak` takes them all."""
ALL = [
    pytest.param(name, marks=FAMILIES.get(name, [pytest.mark.soak]))
    for name in PRESETS
    if name not in ("gacrl-112k", "gacrl-teams")  # gacrl with other numbers
    and not name.startswith("graph-")  # learners of the others
]


def tiny(name: str, **changes: Any) -> RunConfig:
    """A preset on small numbers: everything that it learns with is on from the second update."""
    preset = presets.preset(name)
    algorithm: Any = preset.algorithm
    small: dict[str, Any] = {"replay_capacity": 40, "batch_size": 4, "learning_starts": 4, "updates": 2}
    small = {field: value for field, value in small.items() if hasattr(algorithm, field)}
    if hasattr(algorithm, "network"):
        small["network"] = replace(algorithm.network, width=8)
    if hasattr(algorithm, "update_epochs"):
        small["update_epochs"] = 2
    return replace(
        preset,
        algorithm=replace(algorithm, **small),
        env=replace(preset.env, max_cycles=5),
        training=TrainingConfig(env_steps=64, num_envs=2, num_steps=4),
        evaluation=EvaluationConfig(interval=16, num_episodes=2, final_episodes=2),
        seed=3,
        **changes,
    )


def rows(run: Ended) -> list[dict[str, Any]]:
    lines = (run.folder / "metrics.jsonl").read_text().splitlines()
    return [{name: value for name, value in json.loads(line).items() if name not in TIMES} for line in lines]


def parameters(run: Ended) -> dict[str, bytes]:
    """The newest checkpoint, and the best policy."""
    folders = [max(run.folder.glob("checkpoints/step-*")), *run.folder.glob("checkpoints/best-*")]
    return {folder.name: (folder / "state.safetensors").read_bytes() for folder in folders}


@pytest.mark.parametrize("name", ALL)
def test_2k_steps_are_k_steps_and_k_more(name: str, tmp_path: Path):
    """Parameters, metrics and summary to the bit, of two launches of which one was stopped in the middle."""
    config = tiny(name)
    whole = session.start(config, tmp_path / "whole")
    evaluations = iter(range(1, 9))
    half = session.start(config, tmp_path / "halves", Watcher(stop=lambda: next(evaluations) == 2))
    assert (half.env_steps, half.summary) == (32, None)
    halves = session.resume(tmp_path / "halves")
    assert halves.env_steps == whole.env_steps == 64
    assert rows(halves) == rows(whole)
    assert parameters(halves) == parameters(whole)
    assert whole.summary and halves.summary
    untimed = [
        {part: value for part, value in run.summary.items() if part not in (*TIMES, "versions")}
        for run in (whole, halves)
        if run.summary
    ]
    assert untimed[0] == untimed[1]
    assert (whole.folder / "episodes.gif").read_bytes() == (halves.folder / "episodes.gif").read_bytes()
    assert len({json.dumps(row["update"]) for row in rows(whole)}) == 4, "it learns"


@pytest.mark.soak
@pytest.mark.parametrize("name", [param.values[0] for param in ALL])
def test_members_are_their_seeds_alone(name: str):
    """Within 1e-5 over ten updates, which is what `--num-seeds` promises. (The paper's, and a probe: test_trainer.py.)

    But for a few of QMIX's numbers: where a gradient is next to nothing Adam divides the rounding by it.
    """
    several, single = (build.make_trainer(tiny(name, num_seeds=count)) for count in (2, 1))
    together, _ = several.chunk(several.init((3, 4)), 10)
    for member, seed in enumerate((3, 4)):
        alone, _ = single.chunk(single.init((seed,)), 10)
        assert_nearly_same(named(together, member), named(alone, 0), strays=5 if name == "qmix" else 0)


def named(stacked: Any, member: int) -> dict[str, np.ndarray]:
    """A member's arrays, by their paths."""
    return {
        jax.tree_util.keystr(path): np.asarray(
            jax.random.key_data(leaf) if jax.numpy.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf
        )[member]
        for path, leaf in jax.tree_util.tree_leaves_with_path(stacked)
    }
