"""The paper's grid search, 27 settings of GACRL, and how much of its spread the seeds alone make.

Learning rate, ε₀ and τ₀ are data in the algorithm's `Hyper`, so that all points are members of one compiled program,
as seeds are. Results are kept as they come: a stopped sweep goes on with the members that are missing.
"""

import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple, SupportsIndex

import jax
import numpy as np
from scipy import stats

from gacrl.config import files as configuration
from gacrl.config import presets
from gacrl.config.checks import whole
from gacrl.config.run import RunConfig
from gacrl.errors import UserError
from gacrl.evaluation.evaluate import stream_key
from gacrl.evaluation.statistics import difference, estimate
from gacrl.experiments.provenance import Versions, code_of, doubts
from gacrl.experiments.study import claim_folder
from gacrl.replacing import replace_json
from gacrl.report import figures
from gacrl.report.page import Page
from gacrl.report.screen import Pace
from gacrl.training import build
from gacrl.training.devices import shard_seeds, stack_seeds
from gacrl.training.divergence import not_finite
from gacrl.training.recorder import RunFolder
from gacrl.training.trainer import AbstractTrainer
from gacrl.versions import versions

SCORE = "reward_shaped"
_RESULTS, _MARKER = "results.jsonl", "sweep.json"
_STRETCH = 50
"""Episodes between two lines of progress."""
_FRESH = tuple(range(1_000, 1_005))


class Point(NamedTuple):
    """One setting of the grid."""

    learning_rate: float
    epsilon: float
    temperature: float

    def __str__(self) -> str:
        return f"learning rate {self.learning_rate:g}, ε₀ {self.epsilon:g}, τ₀ {self.temperature:g}"


class Member(NamedTuple):
    """One training: a setting and a seed."""

    point: Point
    seed: int


Scores = dict[Member, float]


@dataclass(frozen=True)
class Grid:
    """What is trained."""

    learning_rates: tuple[float, ...]
    epsilons: tuple[float, ...]
    temperatures: tuple[float, ...]
    choice: Point
    """The paper's."""
    seeds: tuple[int, ...]
    fresh_seeds: tuple[int, ...]
    """On which the winner is trained again, beside the paper's choice."""
    episodes: int
    config: RunConfig

    @property
    def points(self) -> list[Point]:
        return [Point(*numbers) for numbers in product(self.learning_rates, self.epsilons, self.temperatures)]


@dataclass(frozen=True)
class Noise:
    """The spread of the points' means, and what seeds alone would make of it."""

    spread: float
    """Largest less smallest mean."""
    sd: float
    """Of a single training, beyond what its seed does to all points alike."""
    expected: float
    """The spread to expect of as many means if all points were alike."""
    p_value: float
    """How often seeds alone spread them as far (studentised range)."""


@dataclass(frozen=True)
class Sweep:
    """A finished sweep."""

    out: Path
    report: Path
    winner: Point
    means: Mapping[Point, float]
    noise: Noise
    confirmed: Mapping[Point, tuple[float, ...]]
    """The scores on fresh seeds, of the winner and the paper's choice."""
    scores: Mapping[Member, float]
    """Of every training."""
    made_by: Sequence[Versions]

    def to_dict(self) -> dict[str, Any]:
        return {
            "out": str(self.out),
            "report": str(self.report),
            "winner": self.winner._asdict(),
            "means": [{**point._asdict(), "mean": _number(mean)} for point, mean in self.means.items()],
            "noise": asdict(self.noise),
            "confirmed": [{**point._asdict(), "values": values} for point, values in self.confirmed.items()],
            "scores": [_row(member, score) for member, score in self.scores.items()],
            "versions": self.made_by,
        }


def paper_grid(seeds: SupportsIndex = 2, episodes: SupportsIndex = 500) -> Grid:
    """Return the paper's 27 points, by shaped reward over the first 500 episodes.

    Raises UserError for impossible sizes.
    """
    seeds, episodes = whole(seeds, "seeds"), whole(episodes, "episodes")
    if seeds < 2:
        raise UserError(f"--seeds must be at least 2, not {seeds}: with one there is no telling noise from merit")
    if episodes < 1:
        raise UserError(f"--episodes must be at least 1, not {episodes}")
    return Grid(
        learning_rates=(1e-4, 5e-4, 1e-3),
        epsilons=(0.2, 0.3, 0.4),
        temperatures=(1.5, 2.0, 2.5),
        choice=Point(5e-4, 0.3, 2.0),
        seeds=tuple(range(seeds)),
        fresh_seeds=_FRESH,
        episodes=episodes,
        config=presets.preset("paper"),
    )


def sweep(
    grid: Grid, out: Path, say: Callable[[str], None] = lambda line: None, together: int | None = None
) -> Sweep:
    """Train what is missing under `out`, then the winner again, and write `report.html` and `report.md` there.

    together: members trained side by side; by default three for each CPU core, or all of them on an accelerator.
    Raises UserError for a folder that holds something else.
    """
    out = out.absolute()
    asked = {**asdict(grid), "choice": grid.choice._asdict(), "config": configuration.to_dict(grid.config)}
    claim_folder(out, _MARKER, asked, "sweep", lambda held: "a sweep of other settings: choose another --out")
    with RunFolder(out).locked():
        return _sweep(grid, out, say, together)


def _sweep(grid: Grid, out: Path, say: Callable[[str], None], together: int | None) -> Sweep:
    members = [Member(point, seed) for point in grid.points for seed in grid.seeds]
    if together is None:
        together = 3 * jax.local_device_count() if jax.default_backend() == "cpu" else len(members)
    trainer = build.make_trainer(replace(grid.config, num_seeds=together))
    finals = -(-2 * len(grid.fresh_seeds) // together)
    scores = _train_missing(grid, trainer, members, out, say, finals)
    means = {point: float(np.mean([scores[Member(point, seed)] for seed in grid.seeds])) for point in grid.points}
    winner = max(means, key=lambda point: means[point])
    say(
        f"best: {winner} (ε₀: share of random actions at the start, τ₀: temperature of messages at the start); trained "
        "again on fresh seeds beside the paper's choice"
    )
    finalists = list(dict.fromkeys([winner, grid.choice]))
    again = [Member(point, seed) for point in finalists for seed in grid.fresh_seeds]
    scores = _train_missing(grid, trainer, again, out, say)
    confirmed = {point: tuple(scores[Member(point, seed)] for seed in grid.fresh_seeds) for point in finalists}
    table = np.array([[scores[Member(point, seed)] for seed in grid.seeds] for point in grid.points])
    finite = table[np.isfinite(table).all(1)]
    if len(finite) < 2:
        raise UserError(f"all settings but {len(finite)} diverged: there is nothing to compare")
    made = _made_by(out)
    done = Sweep(out, out / "report.html", winner, means, noise_of(finite), confirmed, scores, made)
    _report(grid, done)
    return done


def noise_of(scores: np.ndarray) -> Noise:
    """Return the spread of the means of scores [points, seeds] beside what chance would make of it.

    All points have the same seeds, and so the same starts: a seed's own luck is no part of their differences
    (two-way layout without interaction).
    """
    points, seeds = scores.shape
    rest = scores - scores.mean(1, keepdims=True) - scores.mean(0) + scores.mean()
    freedom = (points - 1) * (seeds - 1)
    sd = float(np.sqrt((rest**2).sum() / freedom))
    spread, error = float(np.ptp(scores.mean(1))), float(sd / np.sqrt(seeds))
    p_value = (
        float(stats.studentized_range.sf(spread / error, points, freedom)) if error > 0 else float(spread == 0)
    )
    return Noise(spread, sd, expected_range(points) * error, p_value)


def expected_range(count: int) -> float:
    """Return the mean of the largest less the smallest of so many standard normal numbers."""
    x = np.linspace(-9.0, 9.0, 20_001)
    below = stats.norm.cdf(x)
    return float(np.trapezoid(1 - below**count - (1 - below) ** count, x))


def _train_missing(
    grid: Grid,
    trainer: AbstractTrainer,
    members: Sequence[Member],
    out: Path,
    say: Callable[[str], None],
    more: int = 0,
) -> Scores:
    """The scores of all these members; those that are not in the folder yet are trained, group by group.

    more: groups that will come after these.
    """
    scores = _read(out)
    missing = [member for member in members if member not in scores]
    groups = [missing[k : k + trainer.num_seeds] for k in range(0, len(missing), trainer.num_seeds)]
    pace = Pace(len(groups) + more)
    for number, group in enumerate(groups):
        say(
            f"group {number + 1} of {len(groups)}: {len(group)} trainings side by side, {grid.episodes} episodes each"
            + (f", the best {len(grid.fresh_seeds)} times more after that" if more and not number else "")
        )
        found = dict(zip(group, _train(grid, trainer, group, say, pace, number), strict=True))
        _append(out, found)
        scores |= found
    return scores


def _train(
    grid: Grid,
    trainer: AbstractTrainer,
    group: Sequence[Member],
    say: Callable[[str], None],
    pace: Pace,
    before: int,
) -> list[float]:
    """The mean score of each member's episodes; −∞ where it diverged, since whoever then stands still scores well.

    A group that is not full is filled up with its last member. before: groups that were trained before it.
    """
    filled = [*group, *[group[-1]] * (trainer.num_seeds - len(group))]
    states = [trainer.init_member(stream_key("training", seed), _hyper(trainer, point)) for point, seed in filled]
    state = shard_seeds(stack_seeds(states), trainer.mesh)
    place = trainer.table.names.index(SCORE)
    total, ended = np.zeros(len(group)), np.zeros(len(group))
    updates = -(-grid.episodes * grid.config.env.max_cycles // grid.config.steps_per_update)
    stretch = min(_STRETCH * grid.config.env.max_cycles // grid.config.steps_per_update, updates)
    for done in range(0, updates, stretch):
        state, report = trainer.chunk(state, min(stretch, updates - done))
        episodes = jax.device_get(report.episodes)
        total += episodes.total[: len(group), place]
        ended += episodes.ended[: len(group)]
        left = pace.left(before + min(done + stretch, updates) / updates)
        say(f"  {_so_far(total, ended)}; {left}")
    numbers = range(len(filled))
    replay = trainer.algorithm.replay(state.learner)
    diverged = {number for number, _, _ in not_finite(numbers, [{}] * len(filled), state.learner, replay)}
    return [
        -math.inf if number in diverged else float(total[number] / ended[number]) for number in range(len(group))
    ]


def _so_far(total: np.ndarray, ended: np.ndarray) -> str:
    """What the members of a group have reached: their scores, summed over so many episodes each."""
    if not ended.all():
        return "no episode has ended"
    return f"episode {int(ended[0])}, mean shaped reward so far {np.mean(total / ended):.2f}"


def _hyper(trainer: AbstractTrainer, point: Point) -> Any:
    hyper = trainer.algorithm.hyper
    return hyper._replace(
        learning_rate=point.learning_rate,
        epsilon=hyper.epsilon._replace(start=point.epsilon),
        temperature=hyper.temperature._replace(start=point.temperature),
    )


def _read(out: Path) -> Scores:
    """The results so far; a line that a crash cut off, or that is no result, is left out and trained again."""
    scores: Scores = {}
    for row in _rows(out):
        try:
            point = Point(row["learning_rate"], row["epsilon"], row["temperature"])
            score = -math.inf if row[SCORE] is None else float(row[SCORE])
            if score < math.inf:
                scores[Member(point, row["seed"])] = score
        except (ValueError, KeyError, TypeError):
            continue
    return scores


def _made_by(out: Path) -> list[Versions]:
    """Return the versions that trained what is in the folder, each once; older lines do not say theirs."""
    found: list[Versions] = []
    for row in _rows(out):
        made = row.get("versions")
        if made and made not in found:
            found.append(made)
    return found


def _rows(out: Path) -> Iterator[dict[str, Any]]:
    """The lines of results; not those that are no objects."""
    path = out / _RESULTS
    for line in path.read_bytes().splitlines() if path.is_file() else []:
        try:
            row = json.loads(line)
        except (ValueError, RecursionError):
            continue
        if isinstance(row, dict):
            yield row


def _row(member: Member, score: float) -> dict[str, Any]:
    return {**member.point._asdict(), "seed": member.seed, SCORE: _number(score)}


def _append(out: Path, found: Scores) -> None:
    rows = [{**_row(member, score), "versions": versions()} for member, score in found.items()]
    with (out / _RESULTS).open("ab+") as file:
        file.seek(0)
        before = file.read()
        cut_off = before and not before.endswith(b"\n")
        file.write((("\n" if cut_off else "") + "".join(json.dumps(row) + "\n" for row in rows)).encode())


def _number(score: float) -> float | None:
    """None for what diverged: JSON has no infinity."""
    return score if math.isfinite(score) else None


def _report(grid: Grid, done: Sweep) -> None:
    page = Page("The paper's grid search")
    for sentence in doubts(done.made_by):
        page.text(sentence)
    page.text(
        f"{len(grid.points)} settings of GACRL as printed, {len(grid.seeds)} seeds each, by shaped reward, the mean "
        f"over the first {grid.episodes} episodes of training."
    )
    page.heading("What chance would make of it")
    page.text(_noise_sentence(done.noise, len(grid.points), len(grid.seeds)))
    page.heading("The winner again, on fresh seeds")
    _confirmation(page, grid, done)
    page.heading("The whole surface")
    shape = (len(grid.learning_rates), len(grid.epsilons), len(grid.temperatures))
    surface = np.array([done.means[point] for point in grid.points]).reshape(shape).transpose(2, 0, 1)
    page.figure(
        figures.heat(
            surface,
            ("τ₀", _labels(grid.temperatures)),
            ("learning rate", _labels(grid.learning_rates)),
            ("ε₀", _labels(grid.epsilons)),
            "shaped reward",
        ),
        f"Shaped reward over the first {grid.episodes} episodes, mean over {len(grid.seeds)} seeds.",
        "surface",
    )
    rows = [
        [
            *(f"{number:g}" for number in point),
            _told(done.means[point]),
            ", ".join(_told(done.scores[Member(point, seed)]) for seed in grid.seeds),
            ", ".join(name for name, it in (("winner", done.winner), ("the paper's", grid.choice)) if it == point),
        ]
        for point in grid.points
    ]
    page.table(("learning rate", "ε₀", "τ₀", "mean", "seeds", ""), rows)
    page.heading("How this was made")
    page.code(f"gacrl sweep paper-grid --seeds {len(grid.seeds)} --episodes {grid.episodes}")
    page.text(code_of(done.made_by))
    page.write(done.out, "report")
    replace_json(done.out / "summary.json", done.to_dict())


def _noise_sentence(noise: Noise, points: int, seeds: int) -> str:
    verdict = "can" if noise.p_value < 0.05 else "cannot"
    return (
        f"The means spread over {noise.spread:.3f}. A single training has a standard deviation of {noise.sd:.3f}, "
        f"beyond what its seed does to all settings alike, so that {points} means of {seeds} seeds would spread over "
        f"{noise.expected:.3f} if all settings were alike; chance spreads them as far as seen with p = "
        f"{noise.p_value:.2g} (studentised range). The settings {verdict} be told apart."
    )


def _confirmation(page: Page, grid: Grid, done: Sweep) -> None:
    rows: list[list[str]] = []
    for point, values in done.confirmed.items():
        found = estimate(values)
        who = "the paper's choice" if point == grid.choice else "the winner"
        rows.append([who, str(point), f"{found.point:.3f} [{found.low:.3f}, {found.high:.3f}]", _listed(values)])
    page.table(("", "setting", "IQM [95 % interval]", "seeds"), rows)
    if done.winner == grid.choice:
        page.text("The winner is the paper's choice.")
        return
    apart = difference(done.confirmed[done.winner], done.confirmed[grid.choice])
    page.text(
        f"The winner less the paper's choice: {apart.point:+.3f} [{apart.low:.3f}, {apart.high:.3f}]: "
        f"{apart.verdict}. With so many seeds a difference of {apart.detectable:.3f} would be seen in 80 % of all "
        "repetitions."
    )


def _listed(values: Iterable[float]) -> str:
    return ", ".join(f"{value:.3f}" for value in values)


def _told(score: float) -> str:
    return f"{score:.3f}" if math.isfinite(score) else "diverged"


def _labels(numbers: Sequence[float]) -> list[str]:
    return [f"{number:g}" for number in numbers]
