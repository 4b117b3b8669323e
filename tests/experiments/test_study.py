"""A folder of planned runs: only what is missing is trained, and a run that diverged is a result."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import TinyRun

from gacrl.config import presets
from gacrl.config.run import RunConfig
from gacrl.experiments.paper.evidence import read_series
from gacrl.experiments.results import why_diverged
from gacrl.experiments.study import Planned, Watch, train_missing
from gacrl.tasks.spread.settings import METRICS
from gacrl.training import session
from gacrl.training.divergence import Diverged
from gacrl.training.recorder import RunFolder
from gacrl.training.watching import Watcher

pytestmark = pytest.mark.xdist_group("runs")


def tiny(folder: Path, seed: int) -> Planned:
    paper = presets.preset("paper")
    config = replace(
        paper,
        env=replace(paper.env, max_cycles=5),
        algorithm=replace(paper.algorithm, replay_capacity=50, batch_size=4),
        training=replace(paper.training, env_steps=30),
        evaluation=replace(paper.evaluation, interval=10, num_episodes=2, final_episodes=2),
        seed=seed,
        num_seeds=2,
    )
    return Planned(f"run {seed}", config, folder / str(seed))


def watched(names: list[str], stop_after: int | None = None) -> Watch:
    """Notes what is told; stops a run after so many evaluations."""

    def watcher(name: str) -> Watcher:
        seen: list[int] = []
        return Watcher(
            progress=lambda progress: seen.append(progress.env_steps),
            finishing=lambda: names.append(f"{name}: {len(seen)}"),
            stop=lambda: stop_after is not None and len(seen) >= stop_after,
        )

    return Watch(run=watcher, finished=lambda name, how: names.append(f"{name}: {how}"))


def test_a_stopped_run_is_resumed_and_a_finished_one_left_alone(
    tiny_run: TinyRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    nothing = {who: dict.fromkeys(METRICS, 0.0) for who in ("random", "noop", "oracle")}
    monkeypatch.setattr(session, "evaluate_scripted", lambda *task: nothing)  # long to compile, and not at stake
    folders = [Path(shutil.copytree(tiny_run.folder, tmp_path / name)) for name in ("finished", "stopped")]
    runs = [Planned(path.name, RunFolder.open(path).config(), path) for path in folders]
    (folders[1] / "summary.json").unlink()
    shutil.rmtree(max((folders[1] / "checkpoints").glob("step-*")))
    said: list[str] = []
    assert train_missing(runs, watched(said))
    first, second = (run.name for run in runs)
    assert said == [f"{first}: there already", f"{second}: 1", f"{second}: done"], "one evaluation was left"
    resumed, whole = (read_series(path) for path in reversed(folders))
    np.testing.assert_array_equal(resumed.episodes, whole.episodes)
    np.testing.assert_allclose(resumed.mean["reward_shaped"], whole.mean["reward_shaped"], rtol=1e-5)
    assert whole.mean["reward_shaped"].shape == (2, len(whole.episodes))


def test_only_what_is_missing_is_trained(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    runs = [tiny(tmp_path, seed) for seed in range(3)]
    started: list[Path] = []

    def start(config: RunConfig, out: Path, watcher: Watcher) -> session.Ended:
        started.append(out)
        folder = RunFolder.create(out, config)
        if watcher.stop():
            return session.Ended(out, config, 10, None)
        folder.write_summary({})
        return session.Ended(out, config, 30, {})

    monkeypatch.setattr(session, "start", start)
    assert not train_missing([tiny(tmp_path, 9), *runs], watched([], stop_after=0)), "stopped: nothing else begins"
    assert [out.name for out in started] == ["9"]
    started.clear()
    (runs[0].folder / "checkpoints").mkdir(parents=True)  # as a run that was killed at once leaves it
    assert train_missing(runs, watched([]))
    shutil.rmtree(runs[1].folder)
    assert train_missing(runs, watched([]))
    assert started == [*(run.folder for run in runs), runs[1].folder]


def test_a_run_that_diverged_is_a_result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def diverge(config: RunConfig, out: Path, watcher: Watcher) -> None:
        RunFolder.create(out, config).write_diverged("loss is nan")  # as a session does
        raise Diverged("seed 0 diverged: loss is nan by environment step 9; try less")

    monkeypatch.setattr(session, "start", diverge)
    run, said = tiny(tmp_path, 0), list[str]()
    assert train_missing([run], watched(said))
    assert train_missing([run], watched(said))
    assert said == [f"{run.name}: diverged", f"{run.name}: there already"]
    assert why_diverged(run.folder) == "loss is nan"
