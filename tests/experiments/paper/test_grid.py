"""`gacrl sweep`: settings as members of one program, resumption, and what is noise."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gacrl.cli.main import main
from gacrl.experiments.paper import grid as sweep
from gacrl.experiments.paper.grid import Grid, Member, Point, expected_range, noise_of, paper_grid
from gacrl.training import build
from gacrl.versions import versions

pytestmark = [pytest.mark.usefixtures("quick_start"), pytest.mark.xdist_group("runs")]


@pytest.fixture
def grid() -> Grid:
    """Four settings, two seeds, four episodes of five steps."""
    paper = paper_grid().config
    config = replace(
        paper,
        env=replace(paper.env, max_cycles=5),
        algorithm=replace(paper.algorithm, replay_capacity=50, batch_size=4),
    )
    return replace(
        paper_grid(seeds=2, episodes=4),
        learning_rates=(5e-4, 0.1),
        epsilons=(0.3,),
        temperatures=(2.0, 2.5),
        fresh_seeds=(50, 51),
        config=config,
    )


def test_the_papers_grid():
    grid = paper_grid()
    assert len(grid.points) == len(set(grid.points)) == 27
    assert grid.choice in grid.points
    assert (grid.seeds, grid.episodes) == ((0, 1), 500)
    assert not set(grid.seeds) & set(grid.fresh_seeds)


def test_it_goes_on_with_what_is_missing_and_its_numbers_are_those_of_single_runs(grid: Grid, tmp_path: Path):
    said: list[str] = []
    done = sweep.sweep(grid, tmp_path / "out", said.append, together=2)
    assert [line for line in said if line.startswith("group")][:2] == [
        "group 1 of 4: 2 trainings side by side, 4 episodes each, the best 2 times more after that",
        "group 2 of 4: 2 trainings side by side, 4 episodes each",
    ]
    assert done.winner == max(done.means, key=lambda point: done.means[point])
    assert set(done.confirmed) == {done.winner, grid.choice}
    assert all(len(values) == 2 for values in done.confirmed.values())

    point, seed = Point(0.1, 0.3, 2.5), 1
    config = grid.config
    algorithm = replace(config.algorithm, learning_rate=0.1, temperature=2.5)
    trainer = build.make_trainer(replace(config, algorithm=algorithm))
    _, report = trainer.chunk(trainer.init((seed,)), 20)
    alone = float(report.episodes.total[0, trainer.table.names.index("reward_shaped")]) / 4
    results = tmp_path / "out" / "results.jsonl"
    scores = {
        Member(Point(row["learning_rate"], row["epsilon"], row["temperature"]), row["seed"]): row["reward_shaped"]
        for row in map(json.loads, results.read_text(encoding="utf-8").splitlines())
    }
    assert scores[Member(point, seed)] == pytest.approx(alone, rel=1e-4)
    assert len(set(np.round(list(scores.values()), 6))) > 4, "the settings make a difference"

    lines = results.read_text(encoding="utf-8").splitlines(keepends=True)
    results.write_text("".join(lines[:3]) + "".join(lines[4:])[:-9], encoding="utf-8")  # one lost, one cut off
    said.clear()
    again = sweep.sweep(grid, tmp_path / "out", said.append, together=2)
    assert "group 1 of 1: 1 trainings side by side, 4 episodes each" in said
    assert again.means == pytest.approx(done.means)
    assert again.to_dict()["winner"] == done.to_dict()["winner"]
    with results.open("ab") as file:  # what is no result: other bytes, no number; and one that diverged
        file.write(
            b'\xff\xfe\n{"learning_rate": 0.1, "epsilon": 0.3, "temperature": 2.5, "seed": 1, "reward_shaped": NaN}\n'
        )
        file.write(
            b'{"learning_rate": 0.1, "epsilon": 0.3, "temperature": 2.0, "seed": 1, "reward_shaped": null, '
            b'"versions": {"git_commit": "abc"}}\n'
        )
    said.clear()
    third = sweep.sweep(grid, tmp_path / "out", said.append, together=2)
    assert third.winner != Point(0.1, 0.3, 2.0)
    kept = json.loads((tmp_path / "out/summary.json").read_text())
    assert kept["means"][2]["mean"] is None
    assert [row["reward_shaped"] for row in kept["scores"]].count(None) == 1
    assert [made.get("git_commit") for made in kept["versions"]] == [versions().get("git_commit"), "abc"]
    assert not any(line.startswith("group") for line in said)

    page = (tmp_path / "out" / "report.md").read_text(encoding="utf-8")
    assert "4 settings of GACRL as printed, 2 seeds each" in page and "diverged" in page
    assert "| 0.1 | 0.3 | 2.5 |" in page
    assert "would spread over" in page and "not of one version of the code" in page
    assert (tmp_path / "out" / "report-figures" / "surface.svg").is_file()


def test_whoever_diverges_does_not_win(grid: Grid, tmp_path: Path):
    """A policy that is no number stands still, which the shaped reward pays better than what these have learned."""
    wild = replace(grid, learning_rates=(5e-4, 1e30))
    done = sweep.sweep(wild, tmp_path / "out", together=4)
    assert done.winner.learning_rate == 5e-4
    assert [done.means[point] for point in wild.points if point.learning_rate > 1] == [-np.inf, -np.inf]


def test_the_range_of_normal_numbers():
    """Tippett 1925: 1.128 of 2, 3.078 of 10, 3.931 of 25."""
    assert [expected_range(n) for n in (2, 10, 25)] == pytest.approx([1.1284, 3.0775, 3.9306], abs=1e-4)


def test_noise_is_what_is_left_after_settings_and_seeds():
    """Residuals ±0.1 in a 2 × 2 layout: sd 0.2, 1 degree of freedom."""
    noise = noise_of(np.array([[1.1, 2.9], [2.9, 5.1]]))
    assert noise.spread == pytest.approx(2.0)
    assert noise.sd == pytest.approx(np.sqrt(4 * 0.1**2))
    assert noise.expected == pytest.approx(1.1284 * 0.2 / np.sqrt(2), abs=1e-4)
    exact = noise_of(np.array([[1.0, 3.0], [3.0, 5.0]]))
    assert (exact.sd, exact.p_value) == (pytest.approx(0.0, abs=1e-12), pytest.approx(0.0, abs=1e-6))


def test_chance_alone_is_called_chance():
    rng = np.random.default_rng(3)
    ps = [noise_of(rng.normal(size=(27, 2)) + rng.normal(size=2)).p_value for _ in range(60)]
    assert 0.3 < np.mean(ps) < 0.7
    assert np.mean(np.array(ps) < 0.05) < 0.2
    shifted = rng.normal(size=(27, 2)) + 3.0 * np.arange(27)[:, None]
    assert noise_of(shifted).p_value < 1e-6


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--seeds", "1"], "--seeds must be at least 2, not 1: with one there is no telling noise from merit"),
        (["--episodes", "0"], "--episodes must be at least 1, not 0"),
        (["--out", "{tmp}/other"], "{tmp}/other exists and holds no sweep: choose another --out"),
        (["--out", "{tmp}/mine"], "{tmp}/mine holds a sweep of other settings: choose another --out"),
    ],
)
def test_mistakes_end_in_one_sentence(
    words: list[str], sentence: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    for name, file in (("other", "letter.txt"), ("mine", "sweep.json")):
        (tmp_path / name).mkdir()
        (tmp_path / name / file).write_text("{}", encoding="utf-8")
    words = [word.format(tmp=tmp_path) for word in words]
    assert main(["sweep", "paper-grid", *words]) == 2
    assert capsys.readouterr().err == f"gacrl: {sentence.format(tmp=tmp_path)}\n"


def test_a_grid_that_there_is_not(capsys: pytest.CaptureFixture[str]):
    assert main(["sweep", "papergrid"]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "paper-grid" in said
