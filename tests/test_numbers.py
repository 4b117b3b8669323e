"""Every number in a table of the README and of docs/results.md is that of a file; files name the commit that made them.

Only the chapter "Without a data file" of docs/results.md is left out. A cell with a number that no rule below recomputes
fails, and so does a table without rules.
"""

import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import pytest

from gacrl.evaluation.statistics import estimate, mean, probability_of_improvement
from gacrl.experiments.talking.kinds import kinds

ROOT = Path(__file__).parent.parent
README, RESULTS = "README.md", "docs/results.md"
SCALING, PETTINGZOO = "docs/scaling.md", "docs/guides/pettingzoo.md"
LEFT_OUT = "Without a data file"
RETURN, COVERED, COVERED_2, TOUCHED = "return_agent_mean", "coverage_final_0.1", "coverage_final_0.2", "collisions"
ALL_COVERED, RAW, SOLVED = "success_final_0.1", "reward_raw", "success_final_0.1"
SETTINGS = ("seeds", "episodes", "environment steps", "aimed at", "summary", "parameters", "a look every")
"""Heads of columns that hold what was asked for."""

Numbers: TypeAlias = Callable[[], tuple[float, ...]]
"""The exact numbers of a cell, in the order in which they are printed."""
Rules: TypeAlias = Mapping[str, Mapping[int, Numbers]]
"""By the first words of a row, by column."""


class Table(NamedTuple):
    """One of a page: where it stands, and its cells without marks."""

    page: str
    section: str
    place: int
    """Among the tables of its section."""
    head: list[str]
    rows: list[list[str]]


@cache
def read(path: str) -> dict[str, Any]:
    return json.loads((ROOT / "docs" / path).read_text(encoding="utf-8"))


def data(name: str) -> dict[str, Any]:
    return read(f"data/{name}.json")


def seeds(name: str, metric: str, play: str = "greedy") -> list[float]:
    return data(name)["final"][play][metric]["values"]


# What a cell may hold


def interval(name: str, metric: str) -> Numbers:
    """The interquartile mean over the seeds and its 95 % bootstrap interval."""
    return lambda: estimate(seeds(name, metric))


def middle(name: str, metric: str) -> Numbers:
    """The interquartile mean alone."""
    return lambda: (estimate(seeds(name, metric)).point,)


def average(name: str, metric: str, play: str = "greedy") -> Numbers:
    """The mean over the seeds and its 95 % bootstrap interval."""
    return lambda: estimate(seeds(name, metric, play), mean)


def span(name: str, metric: str) -> Numbers:
    """The mean over the seeds, the least and the most of them."""

    def found() -> tuple[float, ...]:
        values = seeds(name, metric)
        return float(np.mean(values)), min(values), max(values)

    return found


def each(name: str, metric: str) -> Numbers:
    """Every seed."""
    return lambda: tuple(seeds(name, metric))


def only(name: str, metric: str) -> Numbers:
    """The mean over the seeds; or a policy that has none."""
    return lambda: (float(np.mean(seeds(name, metric))),)


def only_both(name: str) -> Numbers:
    """A scripted policy: its coverage within 0.1 and within 0.2."""
    return lambda: (*seeds(name, COVERED), *seeds(name, COVERED_2))


def beside(name: str, who: str, *metrics: str) -> Numbers:
    """A scripted policy on the same starts."""
    return lambda: tuple(data(name)["references"][who][metric] for metric in metrics)


def first_seen(name: str, metric: str, scale: float = 1.0) -> Numbers:
    """Of every seed that gets there: the first evaluation that sees .9, or of two in a row for `spread`."""

    def found() -> tuple[float, ...]:
        along = data(name)["along"]
        enough = np.array(along[metric]) >= 0.9
        if metric == COVERED:
            enough = enough[:, :-1] & enough[:, 1:]
        return tuple(along["env_steps"][int(seed.argmax())] / scale for seed in enough if seed.any())

    return found


DRIVEN = ("success", RETURN, "crashes")


def junction(name: str) -> dict[int, Numbers]:
    """What cars of every seed did, by column."""
    return {column: each(name, metric) for column, metric in enumerate(DRIVEN, 1)}


def each_of_study(task: str, *path: str) -> Numbers:
    """Every seed of a learner of a study of talk."""

    def found() -> tuple[float, ...]:
        values: Any = data(f"talk-{task}-study")
        for word in path:
            values = values[word]
        return tuple(np.atleast_1d(values))

    return found


def of_study(task: str, *path: str, whole: bool = True) -> Numbers:
    """The mean over those seeds, with its interval or without."""
    values = each_of_study(task, *path)
    return lambda: tuple(estimate(np.array(values()), mean)) if whole else (float(np.mean(values())),)


def of_cell(case: str, kind: str, what: str) -> Numbers:
    """Of a learner of the study of kinds, where it is there: its score with the interval, bits, or steps to .9.

    Steps are in thousands, the median of the seeds that came so far; where some did not: of how many.
    """

    def found() -> tuple[float, ...]:
        cell = data(STUDIED.get(case, "talk-study"))["cases"][case]["kinds"].get(kind)
        if cell is None or what != "steps":
            return () if cell is None or cell[what] is None else tuple(np.atleast_1d(cell[what]))
        came = [steps for steps in cell["steps_to_.9"] if steps is not None]
        middle = (float(np.median(came)) / 1_000,) if came else ()
        return middle if len(came) in (0, len(cell["seeds"])) else (*middle, len(came), len(cell["seeds"]))

    return found


def equal_budget(algorithm: str, side: str) -> Numbers:
    """Of ours or of BenchMARL: median steps a second, each seed's return and its coverage."""

    def found() -> tuple[float, ...]:
        rows = data("benchmarl-60k")[algorithm][side]
        speed = float(np.median([row["steps_per_second"] for row in rows]))
        return speed, *(row[metric] for metric in ("return", "coverage") for row in rows)

    return found


def at_the_end(env: str) -> Numbers:
    """The mean over seeds of a learner whose environment lives in Python, or of the same on ours."""
    return lambda: (float(np.mean(data("host-spread-3-seeds")[env]["return_agent_mean"][-1])),)


def last_50(who: str, trained_on: str, seed: int, measure: str) -> Numbers:
    """Mean and standard deviation of a seed's last 50 episodes of training."""

    def found() -> tuple[float, ...]:
        rows = read("reproduction/results.json")["table_3"]
        row = next(row for row in rows if (row["who"], row["trained_on"]) == (who, trained_on))
        return row["mean"][measure][seed], row["sd"][measure][seed]

    return found


def printed_by_the_paper(column: int) -> Numbers:
    """Mean and standard deviation in the GACRL row of the paper's Table III."""
    file = ROOT / "src" / "gacrl" / "experiments" / "paper" / "paper.json"
    table = json.loads(file.read_text(encoding="utf-8"))["table_3"]
    return lambda: tuple(table["rows"]["GACRL"][column])


# The tables


OF_SPREAD = {
    "final coverage 0.1": COVERED,
    "final coverage 0.2": COVERED_2,
    "return": RETURN,
    "touching pairs": TOUCHED,
    "all three covered": ALL_COVERED,
}


def of_gacrl(name: str) -> dict[str, dict[int, Numbers]]:
    """Rows of metrics: ours, the oracle, random."""
    ours = 2 if "112k" in name else 1
    return {
        label: {ours: interval(name, metric), 3: beside(name, "oracle", metric), 4: beside(name, "random", metric)}
        for label, metric in OF_SPREAD.items()
    }


BASELINES = ("mappo", "ippo", "vdn", "qmix")
SCRIPTED = {"random": "random", "doing nothing": "noop", "oracle": "oracle"}
ANCHORED = ("speaker_listener", "reference", "colours")
TALKED = (*ANCHORED, "colours-full", "colours-unnamed")
STUDIED = {
    "scouts": "talk-study-more",
    "colours-full": "talk-study-more",
    "colours-unnamed": "talk-study-more",
    "traffic_junction": "talk-study-traffic",
}
"""Cases of the study of kinds that were trained later, and their files."""
TALK_ROWS = {
    "speaker_listener": "talk-speaker_listener-10-seeds",
    "reference": "talk-reference-10-seeds",
    "colours, ring, unnamed": "talk-colours-unnamed-10-seeds",
    "colours, ring": "talk-colours-10-seeds",
    "colours, full graph": "talk-colours-full-10-seeds",
}
MEDIUM = {
    "vision 1, 25 environments": "talk-traffic-medium-vision1-3-seeds",
    "vision 1, 100 environments": "talk-traffic-medium-vision1-2m-3-seeds",
    "the same, silenced": "talk-traffic-medium-vision1-2m-silenced",
    "vision 0": "talk-traffic-medium-5m-3-seeds",
    "the same with 200 environments": "talk-traffic-medium-exploring-2-seeds",
    "the team's reward shared": "talk-traffic-medium-shared-4-seeds",
    "the same and a teacher": "talk-traffic-medium-told-in-rounds-4-seeds",
    "a horizon of γ .9": "talk-traffic-medium-short-horizon-3-seeds",
    "its words silenced": "talk-traffic-medium-short-horizon-silenced",
    "its words scrambled": "talk-traffic-medium-short-horizon-scrambled",
    "64 units": "talk-traffic-medium-64-units-3-seeds",
    "their words silenced": "talk-traffic-medium-64-units-silenced",
    "their words scrambled": "talk-traffic-medium-64-units-scrambled",
}
TRAFFIC = {
    "the team's reward shared": "talk-traffic-easy-shared-3-seeds",
    "its words silenced": "talk-traffic-easy-shared-silenced",
    "its words scrambled": "talk-traffic-easy-shared-scrambled",
    "longer exploration and replay, fresh": "talk-traffic-easy-fresh-3-seeds",
    "the same, silenced": "talk-traffic-easy-fresh-silenced",
    "the same, scrambled": "talk-traffic-easy-fresh-scrambled",
    "longer exploration and replay, seeds": "talk-traffic-easy-replay-3-seeds",
    "longer exploration alone": "talk-traffic-easy-250-environments-3-seeds",
    "values of before, 800,000 steps": "talk-traffic-easy-3-seeds",
    "today's, 800,000 steps": "talk-traffic-easy-800k-3-seeds",
    "today's, 2,000,000 steps": "talk-traffic-easy-2m-3-seeds",
    "γ .95 and 100 environments": "talk-traffic-easy-100-environments-3-seeds",
    "the same and 64 units": "talk-traffic-easy-64-units-3-seeds",
    "the same without a price on logits": "talk-traffic-easy-no-price-3-seeds",
}
SOLVES, TALK = "GACRL that solves the task", "Tasks that need talk"
IN_MPE2 = "gacrl-10-seeds-mpe2"
CONTINUOUS, MOVING = "continuous-10-seeds", "moving-10-seeds"
TABLE_3 = ("shaped", "raw", "distance", "coverage_0.1")
TEAMS = {1: "gacrl-teams-4-seeds", 2: "teams-10", 3: "teams-30", 4: "teams-100"}


def verdicts(agreement: str) -> dict[int, Numbers]:
    """How many tests came out so, by what random does."""

    def count(chance: str) -> Numbers:
        def found() -> tuple[float, ...]:
            tests = [
                claim for claim in read("reproduction/results.json")["claims"] if claim["id"] == claim["test"]
            ]
            return (sum((test["agreement"], test["random"]) == (agreement, chance) for test in tests),)

        return found

    chances = ("told from random", "not told from random", "equivalent to random", "")
    return {column: count(chance) for column, chance in enumerate(chances, 1)}


def anchored(task: str) -> Numbers:
    """The best silent policy that is known: the committed anchor of the task."""
    file = ROOT / "src" / "gacrl" / "tasks" / "navigation" / "anchors" / f"{task}.json"
    return lambda: (json.loads(file.read_text(encoding="utf-8"))["scripted"]["silent"][RETURN],)


def by_task(numbers: Callable[[str], Numbers], tasks: Iterable[str] = TALKED) -> dict[int, Numbers]:
    return {column: numbers(task) for column, task in enumerate(tasks, 1)}


def of_part(run: dict[str, Any], *metrics: str) -> dict[int, Numbers]:
    """What remains without a part, and the probability that a seed with it is above."""

    def found(what: str, metric: str) -> Numbers:
        return lambda: tuple(run[what][metric])

    helps = () if run["name"] == "all parts" else metrics
    columns = [found("intervals", metric) for metric in metrics]
    columns += [found("probability_that_the_part_helps", metric) for metric in helps]
    return dict(enumerate(columns, 1))


def parts(folder: str, *metrics: str) -> dict[str, dict[int, Numbers]]:
    return {run["name"]: of_part(run, *metrics) for run in read(f"{folder}/summary.json")["runs"]}


def oracle(name: str) -> dict[int, Numbers]:
    """As a policy of its own, or beside one."""
    if name == "oracle-10-dense":
        return {2: only(name, COVERED), 3: only(name, RETURN)}
    return {2: beside(name, "oracle", COVERED), 3: beside(name, "oracle", RETURN)}


EQUAL = {
    "gacrl": "gacrl-10-seeds",
    "graph-vdn, with these three": "graph-vdn-same-5-seeds",
    **{f"graph-{who}": f"graph-{who}-5-seeds" for who in ("vdn", "mappo", "ippo", "qmix")},
}
ORACLES = {
    "N = 3, arena 1, 25 steps": "gacrl-10-seeds",
    "N = 3, arena 1, 75 steps": "gacrl-112k-4-seeds",
    "N = 5, arena 1.291, 75 steps": "gacrl-teams-4-seeds",
    "N = 10, arena 1, 75 steps": "oracle-10-dense",
    "N = 10, arena 1.826, 75 steps": "teams-10",
    "N = 30, arena 3.162, 75 steps": "teams-30",
    "N = 100, arena 5.774, 75 steps": "teams-100",
}


TABLES: Mapping[tuple[str, str, int], Rules] = {
    (README, "Results", 0): {row: {2: each(name, SOLVED)} for row, name in TALK_ROWS.items()},
    (README, "Results", 1): {
        **{who.upper(): {3: interval(f"{who}-5-seeds", RETURN), 4: interval(f"{who}-5-seeds", COVERED)} for who in BASELINES},
        "gacrl": {3: interval("gacrl-10-seeds", RETURN), 4: interval("gacrl-10-seeds", COVERED)},
        **{who: {3: beside("gacrl-10-seeds", who, RETURN), 4: beside("gacrl-10-seeds", who, COVERED)} for who in ("random", "oracle")},
    },
    (README, "Results", 2): {
        "paper": {column: printed_by_the_paper(column - 1) for column in range(1, 5)},
        **{f"ours, seed {seed}": {c: last_50("GACRL", "paper", seed, m) for c, m in enumerate(TABLE_3, 1)} for seed in range(5)},
        **{label: {c: last_50(who, "", 0, m) for c, m in enumerate(TABLE_3, 1)} for label, who in SCRIPTED.items()},
    },
    (RESULTS, "The paper's algorithm, its whole schedule", 0): {
        **{row: {c: average("paper-5-seeds", m, row.split()[0]) for c, m in enumerate((RETURN, COVERED, RAW), 1)} for row in ("greedy", "sampled")},
        **{label: {c: beside("paper-5-seeds", who, m) for c, m in enumerate((RETURN, COVERED, RAW), 1)} for label, who in SCRIPTED.items()},
    },
    (RESULTS, "Every claim of the paper", 0): {
        "agree": verdicts("agrees"), "disagree": verdicts("disagrees"), "undecided": verdicts("undecided"), "not tested": verdicts("not tested")
    },
    (RESULTS, "The baselines on the standard task", 0): {
        **{who: {2: interval(f"{who}-5-seeds", RETURN), 3: interval(f"{who}-5-seeds", COVERED)} for who in BASELINES},
        **{who: {2: beside("mappo-5-seeds", who, RETURN), 3: beside("mappo-5-seeds", who, COVERED)} for who in ("random", "oracle")},
    },
    (RESULTS, "The baselines on the standard task", 1): {
        who: {
            1: interval(f"{who}-graph-torso-5-seeds", RETURN), 2: middle(f"{who}-5-seeds", RETURN),
            3: interval(f"{who}-graph-torso-5-seeds", COVERED), 4: middle(f"{who}-5-seeds", COVERED),
        }
        for who in BASELINES
    },
    (RESULTS, SOLVES, 0): of_gacrl("gacrl-10-seeds"),
    (RESULTS, SOLVES, 1): {
        label: {1: average(IN_MPE2, metric), 2: beside(IN_MPE2, "oracle", metric)} for label, metric in OF_SPREAD.items()
    },
    (RESULTS, SOLVES, 2): {"gacrl": {1: first_seen("gacrl-10-seeds", COVERED, 1_000)}},
    (RESULTS, SOLVES, 3): {
        label: {1: lambda m=metric: (seeds("gacrl-10-seeds", m)[0],), 2: each("silenced", metric)}
        for label, metric in {"return": RETURN, "final coverage 0.1": COVERED}.items()
    },
    (RESULTS, SOLVES, 4): {
        **of_gacrl("gacrl-112k-4-seeds"),
        "final coverage 0.1": {1: each("gacrl-112k-4-seeds", COVERED), **of_gacrl("gacrl-112k-4-seeds")["final coverage 0.1"]},
    },
    (RESULTS, SOLVES, 5): {
        "coverage 0.1": {column: span(name, COVERED) for column, name in TEAMS.items()},
        "coverage 0.2": {column: span(name, COVERED_2) for column, name in TEAMS.items()},
        "local": {column: only_both(f"local-{size}") for column, size in ((2, 10), (3, 30), (4, 100))},
        "oracle": {column: beside(name, "oracle", COVERED, COVERED_2) for column, name in TEAMS.items()},
    },
    (RESULTS, SOLVES, 6): {
        "landmarks": {1: interval(MOVING, "coverage_mean_0.2"), **{c: beside(MOVING, who, "coverage_mean_0.2") for c, who in ((3, "oracle"), (4, "random"))}},
        "continuous actions: final coverage 0.1": {1: interval(CONTINUOUS, COVERED), 3: beside(CONTINUOUS, "oracle", COVERED), 4: beside(CONTINUOUS, "random", COVERED)},
        "continuous actions: final coverage 0.2": {1: interval(CONTINUOUS, COVERED_2), 3: beside(CONTINUOUS, "oracle", COVERED_2), 4: beside(CONTINUOUS, "random", COVERED_2)},
    },
    (RESULTS, TALK, 0): {row: {3: each(name, SOLVED), 4: first_seen(name, SOLVED, 1_000)} for row, name in TALK_ROWS.items()},
    (RESULTS, TALK, 1): {
        "random": by_task(lambda task: of_study(task, "random", whole=False)),
        "silent": by_task(lambda task: of_study(task, "returns", "silent")),
        "the best silent": by_task(anchored, ANCHORED),
        "talking": by_task(lambda task: of_study(task, "returns", "talking")),
        "told": by_task(lambda task: of_study(task, "returns", "told")),
        "talking, a step late": by_task(lambda task: of_study(task, "played", "a step late", whole=False)),
        "talking, silenced": by_task(lambda task: of_study(task, "played", "silenced", whole=False)),
        "talking, scrambled": by_task(lambda task: of_study(task, "played", "scrambled", whole=False)),
    },
    (RESULTS, TALK, 2): {
        **{row: junction(name) for row, name in TRAFFIC.items()},
        **{who: {1: each_of_study("traffic", "further", "success", who), 2: each_of_study("traffic", "returns", who),
                 3: each_of_study("traffic", "further", "crashes", who)} for who in ("told", "silent")},
        "yielder": {column: beside("talk-traffic-easy-2m-3-seeds", "yielder", metric) for column, metric in enumerate(DRIVEN[:2], 1)},
    },
    (RESULTS, TALK, 3): {
        **{row: junction(name) for row, name in MEDIUM.items()},
        **{row: {column: beside("talk-traffic-medium-5m-3-seeds", who, metric) for column, metric in enumerate(DRIVEN, 1)}
           for row, who in {"yielder": "yielder", "never braking": "noop"}.items()},
    },
    (RESULTS, "Kinds of communication", 0): {
        kind: {
            1: of_cell("reference", kind, "bits"),
            **{column: of_cell(case, kind, what) for column, (case, what) in enumerate(product(ANCHORED, ("score", "steps")), 2)},
        }
        for kind in kinds()
    },
    (RESULTS, "Kinds of communication", 1): {
        kind: {column: of_cell(case, kind, what) for column, (case, what) in enumerate(product(STUDIED, ("score", "steps")), 1)}
        for kind in kinds()
    },
    (RESULTS, "What each part is worth", 0): parts("ablation", COVERED, RETURN, TOUCHED),
    (RESULTS, "What each part is worth", 1): parts("ablation-reference", SOLVED, RETURN),
    (RESULTS, "Equal switches", 0): {
        name: {column: interval(file, metric) for column, metric in enumerate((RETURN, COVERED, COVERED_2, ALL_COVERED), 1)}
        for name, file in EQUAL.items()
    },
    (RESULTS, "Half the gradient steps", 0): {
        "ten": {1: each("gacrl-112k-4-seeds", COVERED), 2: each("gacrl-112k-4-seeds", RETURN)},
        "five": {1: each("gacrl-112k-half-4-seeds", COVERED), 2: each("gacrl-112k-half-4-seeds", RETURN)},
    },
    (RESULTS, "The oracle", 0): {label: oracle(name) for label, name in ORACLES.items()},
}  # fmt: skip


# What is asked of the pages


def plain(cell: str) -> str:
    return cell.strip().replace("*", "").replace("`", "").strip()


def tables(page: str) -> Iterator[Table]:
    """Every table, in order; chapters that are left out are not read."""
    section, place, block = "", 0, list[list[str]]()
    for line in [*(ROOT / page).read_text(encoding="utf-8").splitlines(), ""]:
        if line.startswith("|"):
            block.append([plain(cell) for cell in line.strip().strip("|").split("|")])
        elif block:
            yield Table(page, section, place, block[0], block[2:])
            place, block = place + 1, []
        if line.startswith("#"):
            section, place = line.strip("# "), 0
            if section == LEFT_OUT:
                return


EVERY = [table for page in (README, RESULTS) for table in tables(page)]


def unwrapped(page: str) -> str:
    """Its text, wherever its lines end."""
    return " ".join((ROOT / page).read_text(encoding="utf-8").split())


def numbers_in(text: str) -> list[str]:
    return re.findall(r"-?\d*\.?\d+", text.replace("−", "-"))


def agrees(printed: str, exact: tuple[float, ...]) -> None:
    """Every printed number is the exact one to its last digit."""
    shown = numbers_in(re.sub(r"(?<=\d),(?=\d{3})", "", printed))
    assert len(shown) == len(exact), (printed, exact)
    for number, value in zip(shown, exact, strict=True):
        digit = 10.0 ** -len(number.partition(".")[2])
        assert abs(float(number) - value) <= 0.5 * digit * (1 + 1e-6), (printed, exact)


def rules_of(row: str, rules: Rules) -> Mapping[int, Numbers]:
    """Those whose words begin the row, the longest first: nothing else may follow but what explains."""
    fitting = [words for words in rules if row == words or re.match(rf"{re.escape(words)}[ ,:(/]", row)]
    assert fitting, f"no file is named for the row {row!r}"
    return rules[max(fitting, key=len)]


@pytest.mark.parametrize("table", EVERY, ids=lambda table: f"{table.section[:30]} {table.place}")
def test_every_number_of_a_table_is_that_of_a_file(table: Table):
    rules = TABLES.get((table.page, table.section, table.place))
    assert rules is not None, f"a table of {table.page} has no file: keep one, or move it to {LEFT_OUT!r}"
    for row in table.rows:
        if row[0].startswith("aimed at"):
            continue
        found = rules_of(row[0], rules)
        for column, (head, cell) in enumerate(zip(table.head, row, strict=True)):
            if column in found:
                agrees(cell, found[column]())
            elif column and not head.startswith(SETTINGS):
                assert not numbers_in(cell), f"no file is named for {cell!r} ({row[0]}, {head})"


STEPS_OF = {
    **TALK_ROWS, "gacrl": "gacrl-10-seeds", **{name: f"{who}-5-seeds" for who in BASELINES for name in (who, who.upper())}
}  # fmt: skip
"""Files of the rows that print environment steps."""


def test_environment_steps_are_those_of_the_file():
    looked_at = 0
    for table in (table for table in EVERY if "environment steps" in table.head):
        for row in (row for row in table.rows if row[0] in STEPS_OF):
            number, *million = row[table.head.index("environment steps")].replace(",", "").split()
            steps = float(number) * (1e6 if million == ["M"] else 1)
            assert data(STEPS_OF[row[0]])["env_steps"] == pytest.approx(steps, rel=0.02), row[0]
            looked_at += 1
    assert looked_at == 19


def test_no_rule_is_left_over():
    assert set(TABLES) == {(table.page, table.section, table.place) for table in EVERY}


def test_a_number_without_a_file_is_found():
    """A made-up table fails for a row, a cell and a table that no rule knows."""
    section = "The paper's algorithm, its whole schedule"
    known = next(table for table in EVERY if table.section == section)
    for changed in (
        known._replace(rows=[["another policy", "−1.0", "", ""]]),
        known._replace(rows=[[cell.replace("97.6", "97.5") for cell in row] for row in known.rows]),
        known._replace(head=[*known.head, "more"], rows=[[*row, ".5"] for row in known.rows]),
        known._replace(section="Elsewhere"),
    ):
        with pytest.raises(AssertionError):
            test_every_number_of_a_table_is_that_of_a_file(changed)


FIRST = first_seen("gacrl-10-seeds", COVERED)


def above(name: str, metric: str) -> Numbers:
    """The probability that a seed of gacrl is above one of another learner."""
    return lambda: probability_of_improvement(seeds("gacrl-10-seeds", metric), seeds(name, metric))


def lost(metric: str) -> float:
    """By the first seed, silenced."""
    return seeds("gacrl-10-seeds", metric)[0] - seeds("silenced", metric)[0]


SENTENCES: list[tuple[str, str, Numbers]] = [
    (README, r"Its four seeds end at a coverage of ([^;]*);", each("gacrl-112k-4-seeds", COVERED)),
    (README, r"Coverage .9 is reached after (.*) environment steps", lambda: (min(FIRST()), max(FIRST()))),
    (README, r"fall from a return of (\S*) to", of_study("reference", "returns", "talking", whole=False)),
    (
        README,
        r"fall from a return of .* to (.*)\. `gacrl talk`",
        of_study("reference", "played", "silenced", whole=False),
    ),
    (README, r"silencing `pretrained:gacrl` costs it (.*) of coverage", lambda: (lost(RETURN), lost(COVERED))),
    (
        RESULTS,
        r"above one of `graph-vdn` with probability (.*?) in the return",
        above("graph-vdn-5-seeds", RETURN),
    ),
    (RESULTS, r"in the return and (.*?) in coverage; above", above("graph-vdn-5-seeds", COVERED)),
    (RESULTS, r"with these three, (.*?) and .38", above("graph-vdn-same-5-seeds", RETURN)),
    (RESULTS, r"with these three, .84 .*? and (.*?): five seeds", above("graph-vdn-same-5-seeds", COVERED)),
    (
        RESULTS,
        r"success (\S*) silenced, ",
        of_study("traffic", "further", "success", "talking, silenced", whole=False),
    ),
    (
        RESULTS,
        r"silenced, (\S*) scrambled, ",
        of_study("traffic", "further", "success", "talking, scrambled", whole=False),
    ),
    (
        RESULTS,
        r"scrambled, (\S*) a step late\.",
        of_study("traffic", "further", "success", "talking, a step late", whole=False),
    ),
    (RESULTS, r"talk-beacon-study.json\)\): silent ([^]]*\])", of_study("beacon", "returns", "silent")),
    (RESULTS, r"the talking ones silenced ([^]]*\])", of_study("beacon", "played", "silenced")),
    (RESULTS, r"scrambled (1\.[^]]*\])", of_study("beacon", "played", "scrambled")),
    (RESULTS, r"scouts-study.json\)\), return: silent ([^]]*\])", of_study("scouts", "returns", "silent")),
    (
        RESULTS,
        r"scouts-study.json\)\), return: silent [^]]*\], talking ([^]]*\])",
        of_study("scouts", "returns", "talking"),
    ),
    (RESULTS, r"told (−9[^]]*\])", of_study("scouts", "returns", "told")),
    (RESULTS, r"silenced (−12[^]]*\])", of_study("scouts", "played", "silenced")),
    (RESULTS, r"scrambled (−12[^]]*\])", of_study("scouts", "played", "scrambled")),
    (
        RESULTS,
        r"than a silent one with probability ([^]]*\]), and",
        lambda: tuple(data("talk-scouts-study")["improvement"]),
    ),
    (RESULTS, r"scrambling costs them ([^]]*\])", lambda: tuple(data("talk-scouts-study")["used"])),
    *(
        (SCALING, rf"\| {algorithm.upper()}, {label} \| ((?:[^|]*\|){{3}})", equal_budget(algorithm, side))
        for algorithm in ("mappo", "ippo")
        for side, label in {"ours": "ours", "benchmarl": "BenchMARL 1.5.2"}.items()
    ),
    (PETTINGZOO, r"ends at (\S*) on the real", at_the_end("mpe2")),
    (PETTINGZOO, r"simple_spread_v3` and at (\S*) on our", at_the_end("spread")),
    (
        RESULTS,
        r"the second one carries (\S*) of its",
        lambda: (data(IN_MPE2)["messages"]["bits_used_last_round"],),
    ),
]


@pytest.mark.parametrize(("page", "sentence", "exact"), SENTENCES, ids=[words[:30] for _, words, _ in SENTENCES])
def test_numbers_in_sentences_are_those_of_their_file(page: str, sentence: str, exact: Numbers):
    found = re.search(sentence, unwrapped(page))
    assert found is not None, f"{page} does not say {sentence!r}"
    agrees(found[1], exact())


def test_the_claims_are_counted_by_test():
    claims = read("reproduction/results.json")["claims"]
    tests = [claim for claim in claims if claim["id"] == claim["test"]]
    text = unwrapped(RESULTS)
    assert f"The {len(claims)} claims rest on {len(tests)} tests" in text


UNNOTED = {"data/talk-traffic-easy-3-seeds.json"}
"""Kept before a run had to know its commit; they say so, and docs/results.md beside their numbers."""


@pytest.mark.parametrize(
    "file",
    ["reproduction/results.json", "ablation/summary.json", "ablation-reference/summary.json", "grid/summary.json", *(f"data/{p.name}" for p in sorted((ROOT / "docs" / "data").glob("*.json")))],
)  # fmt: skip
def test_every_file_names_the_one_clean_commit_that_made_it(file: str):
    versions = read(file)["versions"]
    (made,) = versions if isinstance(versions, list) else [versions]
    if file in UNNOTED:
        assert "noted no commit" in read(file)["commit_from"]
        return
    assert "commit_from" not in read(file)
    assert re.fullmatch(r"[0-9a-f]{40}", made["git_commit"]) and made["jax"] and made["python"]
