"""A run from start to end in one process: whose error it is, and where it is written."""

import os
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import gacrl
from gacrl.config import files as configuration
from gacrl.config import presets
from gacrl.config.run import RunConfig
from gacrl.errors import ConfigError
from gacrl.experiments import ablate, search, study
from gacrl.experiments.paper import reproduce
from gacrl.training import session
from gacrl.training.divergence import Diverged
from gacrl.training.watching import Watcher

pytestmark = pytest.mark.usefixtures("one_trainer")

TINY: dict[str, Any] = {
    "algorithm": {"network": {"width": 8}},
    "env": {"max_cycles": 5},
    "training": {"env_steps": 40, "num_envs": 2, "num_steps": 5},
    "evaluation": {"interval": 20, "num_episodes": 2, "final_episodes": 2},
}


@pytest.fixture(scope="module", autouse=True)
def no_references() -> Iterator[None]:
    """What scripted policies reach does not matter here."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(session, "evaluate_scripted", lambda *_: {"random": {}, "noop": {}, "oracle": {}})
        patch.setattr(session, "normalised", lambda metrics, references, scale: metrics)
        yield


@pytest.fixture
def config() -> RunConfig:
    return configuration.from_dict(TINY, presets.preset("ippo"))


def raising(error: BaseException) -> Callable[..., Any]:
    def callback(*_: Any) -> Any:
        raise error

    return callback


@pytest.mark.parametrize("callback", ["planned", "compiling", "progress", "finishing", "finished", "stop"])
def test_an_error_of_a_watcher_is_raised_as_it_is(callback: str, config: RunConfig, tmp_path: Path):
    """A lost connection is an OSError, and none of the disk's; the run can be resumed."""
    error = ConnectionError("tracker: connection refused")
    with pytest.raises(ConnectionError) as raised:
        session.start(config, tmp_path / "run", Watcher(**{callback: raising(error)}))
    assert raised.value is error
    whole = session.resume(tmp_path / "run")
    assert whole.env_steps == 40 and whole.summary is not None
    assert [row["env_steps"] for row in session.RunFolder(tmp_path / "run").metrics()] == [20, 40]


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), Diverged("mine"), KeyError("mine")])
def test_what_kind_of_error_it_is_does_not_matter(error: Exception, config: RunConfig, tmp_path: Path):
    with pytest.raises(type(error)) as raised:
        session.start(config, tmp_path / "run", Watcher(progress=raising(error)))
    assert raised.value is error


def test_a_run_is_written_in_one_place_wherever_the_process_goes(
    config: RunConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    home, other = tmp_path / "home", tmp_path / "other"
    home.mkdir(), other.mkdir()
    for begin in (
        lambda watcher: session.start(config, Path("run"), watcher),
        lambda watcher: session.start(config, None, watcher),
        lambda watcher: session.resume(Path("run"), 20, watcher),
    ):
        monkeypatch.chdir(home)
        done = begin(Watcher(planned=lambda *_: os.chdir(other), progress=lambda _: os.chdir(tmp_path)))
        assert done.folder.is_absolute() and (done.folder / "summary.json").is_file()
    assert not any(other.iterdir()) and {path.name for path in tmp_path.iterdir()} == {"home", "other"}
    assert [row["env_steps"] for row in session.RunFolder(home / "run").metrics()] == [20, 40, 60]
    assert (home / "runs" / "ippo-1" / "episodes.gif").is_file()


def test_studies_stay_where_they_were_begun(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    trained: list[Path] = []

    def stopped(runs: Any, watch: Any) -> bool:
        trained.extend(run.folder for run in runs)
        return False

    for room in (ablate, search, reproduce):
        monkeypatch.setattr(room, "train_missing", stopped)
    home, other = tmp_path / "home", tmp_path / "other"
    home.mkdir(), other.mkdir()
    watch = study.Watch(planned=lambda _: os.chdir(other))
    spec = search.Spec(
        presets.preset("ippo"), (search.Searched("seed", "integer", (0, 9)),), "return_agent_mean", True, 1
    )
    for name, begin in {
        "ablation": lambda out: ablate.ablate(presets.preset("gacrl"), out, watch=watch),
        "search": lambda out: search.search(spec, out, watch),
        "reproduction": lambda out: reproduce.reproduce(out, watch=watch),
    }.items():
        monkeypatch.chdir(home)
        assert begin(Path(name)) is None
        assert trained[-1].is_relative_to(home / name)
    assert not any(other.iterdir())


@pytest.mark.usefixtures("unchecked")
def test_numbers_of_numpy_are_numbers(config: RunConfig, tmp_path: Path):
    (seed,) = np.arange(3, 4)
    run = gacrl.train(replace(config, seed=9), seed=seed, out=tmp_path / "run")
    assert run.config == replace(config, seed=3)
    assert session.resume(run.folder, np.int64(20)).env_steps == 60
    with pytest.raises(ConfigError, match=r"^run.seed must be a whole number, not the string '4'$"):
        gacrl.train(config, seed="4", out=tmp_path / "other")  # pyright: ignore[reportArgumentType]
    with pytest.raises(ConfigError, match=r"^extend must be at least 1, not 0$"):
        session.resume(run.folder, 0)
    assert not (tmp_path / "other").exists()


def test_the_seconds_of_a_run_count_the_closing_evaluation_and_the_pictures(
    config: RunConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """The summary comes last: where it is, the pictures are as well."""
    seconds: list[float] = []

    def gif(*_: Any, **__: Any) -> None:
        assert not (tmp_path / "run" / "summary.json").exists()
        time.sleep(0.5)

    monkeypatch.setattr(session.reel, "gif", gif)
    watcher = Watcher(progress=lambda progress: seconds.append(progress.clock.wall))
    run = session.start(config, tmp_path / "run", watcher)
    assert run.summary is not None
    assert run.summary["wall_seconds"] > seconds[-1] + 0.5
