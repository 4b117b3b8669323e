"""`gacrl sweep FILE.toml`: what a file may say, where its trials lie, and that nothing finished is trained again."""

import json
import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gacrl.cli.main import main
from gacrl.config import files as configuration
from gacrl.config import presets
from gacrl.config.algorithms import GacrlPaperConfig
from gacrl.config.run import RunConfig
from gacrl.experiments import search, study
from gacrl.experiments.search import Searched, proposals
from gacrl.experiments.study import Watch
from gacrl.training.divergence import Diverged
from gacrl.training.recorder import RunFolder
from gacrl.training.session import Ended
from gacrl.training.watching import Watcher

FILE = """
preset = "ippo"
metric = "coverage_final_0.1"
trials = 6
seeds = 2
seed = 3
env_steps = 400

[fixed]
training.num_envs = 4

[search]
algorithm.learning_rate = {log = [1e-4, 1e-2]}
algorithm.gamma = {uniform = [0.8, 0.9]}
algorithm.update_epochs = {integer = [1, 4]}
algorithm.network.width = {choice = [32, 64]}
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    (tmp_path / "search.toml").write_text(FILE, encoding="utf-8")
    return tmp_path / "search.toml"


@pytest.fixture
def trained(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Instead of training a run is written whose metric is 100 × its learning rate; the rates that were trained."""
    rates: list[float] = []

    def start(config: RunConfig, out: Path, watcher: Watcher) -> Ended:
        assert not isinstance(config.algorithm, GacrlPaperConfig)
        rate = config.algorithm.learning_rate
        rates.append(rate)
        folder = RunFolder.create(out, config)
        for steps, value in ((200, 5.0), (400, 100 * rate)):
            rows = [(seed, value + shift) for seed, shift in zip(config.seeds, (-0.1, 0.1), strict=True)]
            folder.append_metrics(
                [{"seed": s, "env_steps": steps, "greedy": {"coverage_final_0.1": v}} for s, v in rows]
            )
        if rate > 5e-3:
            folder.write_diverged("seed 3 diverged: loss is nan by environment step 400")
            raise Diverged("seed 3 diverged: loss is nan by environment step 400; try a smaller one")
        folder.write_summary({})
        return Ended(out, config, 400, {})

    monkeypatch.setattr(study.session, "start", start)
    return rates


def test_trials_fill_the_ranges(file: Path):
    spec = search.load(file)
    assert (spec.config.num_seeds, spec.config.seed, spec.config.training.num_envs) == (2, 3, 4)
    points = proposals(spec)
    assert len(points) == 6
    rates = [point["algorithm.learning_rate"] for point in points]
    assert all(1e-4 <= rate < 1e-2 for rate in rates)
    assert {rate < 1e-3 for rate in rates} == {True, False}
    assert all(0.8 <= point["algorithm.gamma"] < 0.9 for point in points)
    assert {point["algorithm.update_epochs"] for point in points} <= {1, 2, 3, 4}
    assert {point["algorithm.network.width"] for point in points} == {32, 64}
    more = proposals(search.load(_changed(file, "trials = 6", "trials = 9")))
    assert more[:6] == points, "a longer search begins as the shorter one"
    other = proposals(search.load(_changed(file, "seed = 3", "seed = 4")))
    assert other != points


def test_the_example_of_the_guide_is_a_search(tmp_path: Path):
    guide = Path(__file__).parents[2] / "docs/guides/cluster.md"
    (tmp_path / "guide.toml").write_text(guide.read_text(encoding="utf-8").split("```toml\n")[1].split("```")[0])
    spec = search.load(tmp_path / "guide.toml")
    assert spec.config.training == replace(presets.preset("ippo").training, num_envs=32, env_steps=500_000)
    assert [one.kind for one in spec.searched] == ["log", "uniform", "integer", "choice"]


def test_the_ends_of_ranges():
    shares = np.linspace(0, 1, 1000, endpoint=False)
    whole = [Searched("a", "integer", (1, 3)).at(share) for share in shares]
    assert [whole.count(k) for k in (1, 2, 3)] == pytest.approx([333, 333, 333], abs=1)
    logs = [Searched("a", "log", (1e-4, 1e-2)).at(share) for share in shares]
    assert np.median(logs) == pytest.approx(1e-3, rel=0.01)
    assert Searched("a", "uniform", (2, 4)).at(0.5) == 3.0
    assert [Searched("a", "choice", ("x", "y")).at(share) for share in (0.0, 0.49, 0.5, 0.99)] == [
        "x",
        "x",
        "y",
        "y",
    ]


def test_choices_alone_are_tried_once_each(file: Path):
    ranges = "[search]\nalgorithm.reward = {choice = ['own', 'team']}\nalgorithm.network.depth = {choice = [1, 2]}"
    file.write_text(FILE.partition("[search]")[0] + ranges, encoding="utf-8")
    points = proposals(search.load(file))
    assert {tuple(point.values()) for point in points} == {("own", 1), ("own", 2), ("team", 1), ("team", 2)}
    assert len(points) == 4


def test_a_search_goes_on_where_it_was_stopped_and_ranks_what_it_tried(
    file: Path,
    tmp_path: Path,
    trained: list[float],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    out = tmp_path / "out"
    spec = search.load(file)
    rates = [point["algorithm.learning_rate"] for point in proposals(spec)]

    def killed(name: str, how: str) -> None:
        if len(trained) == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        search.search(spec, out, Watch(finished=killed))
    assert trained == pytest.approx(rates[:3])
    monkeypatch.chdir(tmp_path)
    assert main(["sweep", str(file), "--out", str(out), "--json"]) == 0
    assert trained == pytest.approx(rates), "each was trained once"

    said = json.loads(capsys.readouterr().out.splitlines()[-1])
    fine = sorted((rate for rate in rates if rate <= 5e-3), reverse=True)
    finished = [trial for trial in said["trials"] if trial["state"] == "finished"]
    assert [trial["value"] for trial in finished] == pytest.approx([100 * rate for rate in fine])
    assert len(fine) < 6, "one diverged"
    assert {trial["state"] for trial in said["trials"][len(fine) :]} == {"diverged"}
    best = configuration.load(out / "best.json")
    assert best.algorithm.learning_rate == pytest.approx(fine[0])
    assert best == RunFolder.open(out / "trials" / finished[0]["name"]).config()
    report = (out / "report.md").read_text(encoding="utf-8")
    assert f"| {finished[0]['name']} | {fine[0]:.4g} |" in report
    assert "diverged at 400" in report

    assert main(["sweep", str(_changed(file, "trials = 6", "trials = 7")), "--out", str(out)]) == 0
    assert len(trained) == 7, "a longer search takes up the shorter one"
    assert main(["sweep", str(_changed(file, "[1e-4, 1e-2]", "[1e-4, 1e-1]")), "--out", str(out)]) == 2
    assert "holds a search of other settings" in capsys.readouterr().err


def test_the_smallest_can_be_the_best(file: Path, tmp_path: Path, trained: list[float]):
    spec = search.load(_changed(file, "trials = 6", 'trials = 6\ndirection = "minimize"'))
    done = search.search(spec, tmp_path / "out", Watch())
    assert done is not None
    assert done.trials[0].value == pytest.approx(100 * min(trained))
    assert math.isclose(done.trials[0].values["algorithm.learning_rate"], min(trained))


def _changed(file: Path, old: str, new: str) -> Path:
    assert old in FILE
    changed = file.with_name("changed.toml")
    changed.write_text(FILE.replace(old, new), encoding="utf-8")
    return changed


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("trials = 6", "trails = 6", "unknown key 'trails': did you mean 'trials'?"),
        ("trials = 6", "", "it does not say trials: a search needs metric, trials and [search]"),
        ("trials = 6", "trials = 0", "trials must be a whole number between 1 and 100000, not 0"),
        ("trials = 6", "trials = 6\ndirection = 'up'", "direction must be 'maximize' or 'minimize', not 'up'"),
        (
            '"coverage_final_0.1"',
            '"coverage_final_0,1"',
            "unknown metric 'coverage_final_0,1': did you mean 'coverage_final_0.1'?",
        ),
        ('"ippo"', '"ipo"', "unknown preset 'ipo': did you mean 'ippo'? (see `gacrl presets`)"),
        (
            "training.num_envs",
            "training.num_env",
            "unknown setting 'training.num_env': did you mean 'training.num_envs'?",
        ),
        ("env_steps = 400", "env_steps = 0", "training.env_steps must be between 1 and 1e+12, not 0"),
        ("algorithm.gamma", "algorithm.gama", "unknown setting 'algorithm.gama': did you mean 'algorithm.gamma'?"),
        ("algorithm.gamma", "gamma", "unknown setting 'gamma': "),
        ("[0.8, 0.9]", "[0.9, 0.8]", "algorithm.gamma has an empty range: 0.9 is not below 0.8"),
        ("[0.8, 0.9]", "[]", "algorithm.gamma has an empty range: give uniform a list of values"),
        ("[0.8, 0.9]", "[0.8]", "algorithm.gamma needs two numbers, lowest and highest, not [0.8]"),
        ("[0.8, 0.9]", "[0.8, 1.9]", "algorithm.gamma must be between 0 and 1, not 1.9"),
        (
            "[1e-4, 1e-2]",
            "[0.0, 1e-2]",
            "algorithm.learning_rate cannot be searched by log down to 0.0: begin above 0",
        ),
        (
            "{integer = [1, 4]}",
            "{integer = [1, 4.5]}",
            "algorithm.update_epochs needs two numbers, lowest and highest",
        ),
        (
            "{integer = [1, 4]}",
            "{uniform = [1.5, 4.5]}",
            "algorithm.update_epochs must be a whole number, not 1.5",
        ),
        ("{integer = [1, 4]}", "{integers = [1, 4]}", "algorithm.update_epochs.integers must be one of {uniform"),
        ("[32, 64]", "[32, 'wide']", "algorithm.network.width must be a whole number, not the string 'wide'"),
        ("[search]", "[search]\n[more]", "unknown key 'more': "),
        ("metric =", "metric", " is not TOML: "),
    ],
)
def test_a_file_that_cannot_be_is_refused(
    old: str, new: str, sentence: str, file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    path = _changed(file, old, new)
    assert main(["sweep", str(path), "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert str(path) in said
    assert sentence in said
    assert said.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["none.toml"], "cannot read the search none.toml: No such file or directory; or is it 'paper-grid'?"),
        (
            ["{file}", "--seeds", "3"],
            "--seeds and --episodes are for paper-grid: say seeds and env_steps in {file}",
        ),
        (["{file}", "--trial-cpus", "0"], "--trial-cpus must be above 0, and --trial-gpus not below it"),
        (
            ["paper-grid", "--ray", "auto"],
            "paper-grid is one compiled program and needs no cluster: leave --ray out",
        ),
        (["{file}", "--ray", "auto"], "--ray needs Ray and Optuna: pip install 'gacrl[ray]'"),
    ],
)
def test_a_command_that_cannot_be_is_refused(
    words: list[str],
    sentence: str,
    file: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    monkeypatch.setitem(sys.modules, "ray", None)  # as if it were not installed
    monkeypatch.delitem(sys.modules, "gacrl.experiments.ray_search", raising=False)
    assert main(["sweep", *(word.format(file=file) for word in words)]) == 2
    assert capsys.readouterr().err == f"gacrl: {sentence.format(file=file)}\n"
