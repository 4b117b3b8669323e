"""What a run needs is known before it is allocated."""

import resource
from collections.abc import Callable
from pathlib import Path

import jax
import pytest

from gacrl.config import presets
from gacrl.training import build, footprint

pytestmark = pytest.mark.usefixtures("quick_start")


@pytest.mark.parametrize(
    "words",
    [
        "--algorithm.replay-capacity 10000000 --training.num-envs 100000 --num-seeds 100",
        "--preset mappo --training.num-steps 1000000 --training.num-envs 1000",
        "--preset paper --algorithm.batch-size 1000000 --env.num-agents 3000",
        "--preset ippo --algorithm.network.width 65536 --algorithm.network.depth 9",
        "--preset mappo --env.num-agents 10000",
        "--preset qmix --evaluation.final-episodes 100000 --env.num-agents 500",
    ],
)
def test_what_cannot_fit_is_refused_with_the_number(
    words: str, tmp_path: Path, said: Callable[..., tuple[int, str]], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(footprint, "memory_of", lambda device: 16 * 2**30)
    out = tmp_path / "run"
    before = int(Path("/proc/self/statm").read_text().split()[1])
    code, sentence = said("train", *words.split(), "--out", out)
    assert code == 2
    assert sentence.startswith("gacrl: this run needs at least ")
    needed, unit = sentence.split("at least ")[1].split(" of memory")[0].split(" ")
    assert float(needed.replace(",", "")) > 16 or unit != "GiB"
    assert "and cpu:0 has 16.0 GiB" in sentence
    assert not out.exists()
    grown = (int(Path("/proc/self/statm").read_text().split()[1]) - before) * resource.getpagesize()
    assert grown < 2**30, "nothing large was allocated to find out"


def test_the_plan_of_a_run_counts_its_replay():
    config = presets.preset("gacrl")
    trainer = build.make_trainer(config)
    planned = build.plan(trainer, config)
    member = jax.eval_shape(lambda: trainer.init_stacked((0,)))
    state = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(member))
    assert planned.bytes_per_seed == state
    assert planned.bytes_per_seed > 150_000 * 4 * 100
    assert 2 * state < planned.bytes_needed < 2.5 * state
