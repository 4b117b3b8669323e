"""What a run needs is known before it is allocated."""

import resource
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import jax
import pytest

from gacrl.config import files, presets
from gacrl.training import build, footprint


@pytest.mark.parametrize(
    "words",
    [
        "--algorithm.replay-capacity 10000000 --training.num-envs 100000 --num-seeds 100",
        "--preset mappo --training.num-steps 1000000 --training.num-envs 1000",
        "--preset paper --algorithm.batch-size 1000000 --env.num-agents 3000",
        "--preset ippo --algorithm.network.width 65536 --algorithm.network.depth 9",
        "--preset mappo --env.num-agents 10000",
        "--preset qmix --evaluation.final-episodes 100000 --env.num-agents 500",
        "--preset ippo --env.num-agents 100 --env.max-cycles 1000000",  # the episodes that are kept to look at
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


@pytest.mark.parametrize(
    "words",
    [
        "evaluate oracle --num-agents 3000 --horizon 2",
        "evaluate pretrained:gacrl-teams --num-agents 1000 --episodes 2000",
        "render random --num-agents 2000 --horizon 1000",
    ],
)
def test_episodes_that_cannot_fit_are_not_played(
    words: str, said: Callable[..., tuple[int, str]], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    monkeypatch.setattr(footprint, "memory_of", lambda device: 16 * 2**30)
    monkeypatch.chdir(tmp_path)
    code, sentence = said(*words.split())
    assert code == 2
    assert sentence.startswith("gacrl: to play these episodes takes at least ")
    assert float(sentence.split("at least ")[1].split(" GiB")[0].replace(",", "")) > 16
    assert "and cpu:0 has 16.0 GiB: take fewer or shorter episodes" in sentence
    assert not any(tmp_path.iterdir())


def test_a_process_has_no_more_memory_than_its_limits_say(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Those of a cluster's job, of the slice around it, and of a container, in both versions of control groups."""
    device, machine = jax.devices()[0], footprint.memory_of(jax.devices()[0])
    job = tmp_path / "new" / "slurm" / "job_1" / "step_0"
    job.mkdir(parents=True)
    (job / "memory.max").write_text("max\n")
    (job.parent / "memory.max").write_text("3000000000\n")
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "memory.limit_in_bytes").write_text("9223372036854771712\n")
    (tmp_path / "cgroup").write_text("4:cpu,memory:/elsewhere\n0::/slurm/job_1/step_0\n")
    monkeypatch.setattr(footprint, "_OWN_CGROUPS", tmp_path / "cgroup")
    new, old = (
        (str(tmp_path / "new"), "", "memory.max"),
        (str(tmp_path / "old"), "memory", "memory.limit_in_bytes"),
    )
    monkeypatch.setattr(footprint, "_CGROUPS", (new, old))
    assert footprint.memory_of(device) == 3_000_000_000
    (tmp_path / "old" / "memory.limit_in_bytes").write_text("2000000000\n")
    assert footprint.memory_of(device) == 2_000_000_000
    monkeypatch.setattr(footprint, "_CGROUPS", ())
    assert machine is not None and machine <= footprint.memory_of(device)
    monkeypatch.setattr(resource, "getrlimit", lambda kind: (10**9, resource.RLIM_INFINITY))
    assert footprint.memory_of(device) == 10**9, "ulimit -v"


def test_the_plan_of_a_run_counts_its_replay():
    config = presets.preset("gacrl")
    trainer = build.make_trainer(config)
    planned = build.plan(trainer, config)
    member = jax.eval_shape(lambda: trainer.init_stacked((0,)))
    state = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(member))
    assert planned.bytes_per_seed == state
    assert planned.bytes_per_seed > 150_000 * 4 * 100
    assert 2 * state < planned.bytes_needed < 2.5 * state


def test_seeds_that_take_turns_on_a_device_have_one_state_beside_theirs():
    """Three replays lie there once: the chunk works in their place, and in a copy of the one whose turn it is."""
    config = files.from_dict({"num_seeds": 3, "algorithm": {"replay_capacity": 30_000}}, presets.preset("vdn"))
    one_device = build.mesh(replace(config, num_seeds=1))
    trainer = build.make_trainer(config, one_device)
    state = footprint.size(build.member_shapes(trainer))
    assert build.plan(trainer, config).bytes_needed > 7 * state
    trainer.for_speed = False
    used = trainer.make_chunk().lower(build.stacked_shapes(trainer), 1).compile().memory_analysis()
    assert used.alias_size_in_bytes >= 3 * state, "states are written where they were"
    assert used.temp_size_in_bytes < 1.2 * state
