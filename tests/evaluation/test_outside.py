"""Our statistics and our export beside rliable's and marl-eval's; benchmarks/outside_statistics.py asked these."""

import importlib.util
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gacrl.evaluation.statistics import estimate, iqm, mean, median, probability_of_improvement

ROOT = Path(__file__).parents[2]
FOUND: dict[str, Any] = json.loads((Path(__file__).parent / "outside.json").read_text(encoding="utf-8"))
REPS = 20_000


@pytest.fixture(scope="module")
def asked() -> Any:
    """The script that asked them, which needs neither of them to read our files."""
    spec = importlib.util.spec_from_file_location("outside", ROOT / "benchmarks" / "outside_statistics.py")
    assert spec is not None and spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    return script


def close(ours: Any, theirs: list[float]) -> None:
    """The same point; bounds that differ by what chance makes of so many resamples."""
    np.testing.assert_allclose(ours[0], theirs[0], rtol=1e-9)
    np.testing.assert_allclose(ours[1:3], theirs[1:], rtol=0, atol=0.03 * (theirs[2] - theirs[1]) + 1e-9)


def test_estimates_and_improvements_are_rliables(asked: Any):
    scores = {who: np.array([asked.seeds_of(who)[m] for m in asked.METRICS]).T for who in asked.PRESETS}
    theirs = FOUND["rliable"]
    for k, metric in enumerate(asked.METRICS):
        for who, values in scores.items():
            close(estimate(values[:, k], reps=REPS), theirs["each metric, iqm"][f"{who}/{metric}"])
    for name, statistic in (("iqm", iqm), ("mean", mean), ("median", median)):
        for who, values in scores.items():
            close(estimate(values, statistic, reps=REPS), theirs[f"both metrics, {name}"][who])
    for pair, found in theirs["probability of improvement"].items():
        first, second = (scores[who] for who in pair.split("/"))
        close(probability_of_improvement(first, second, reps=REPS), found)


def test_the_readmes_table_of_baselines_is_rliables(asked: Any):
    """Points to the last printed digit, bounds within 1.5 of them; what is printed is one of our draws of 2,000."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8").replace("−", "-")
    for who in ("VDN", "QMIX", "IPPO", "MAPPO"):
        line = next(line for line in readme.splitlines() if line.startswith(f"| {who} |"))
        printed = [[float(n) for n in cell] for cell in re.findall(r"(-?[\d.]+) \[(-?[\d.]+), (-?[\d.]+)\]", line)]
        for metric, cell, digit in zip(asked.METRICS, printed, (0.01, 0.001), strict=True):
            theirs = FOUND["rliable"]["each metric, iqm"][f"{who.lower()}/{metric}"]
            assert abs(cell[0] - theirs[0]) <= 0.5 * digit + 1e-9, line
            values = asked.seeds_of(who.lower())[metric]
            np.testing.assert_allclose(estimate(values, reps=REPS)[1:3], theirs[1:], atol=1.5 * digit, rtol=0)
            draws = np.array([estimate(values, seed=seed)[1:3] for seed in range(20)])
            half = 0.5 * digit + 1e-9
            assert (draws.min(0) - half <= cell[1:]).all() and (cell[1:] <= draws.max(0) + half).all(), line


def test_marl_eval_reads_our_export_as_we_mean_it(asked: Any):
    """The very export of today, every seed's closing value under its metric and algorithm."""
    assert asked.digest(asked.exported()) == FOUND["export"]
    for metric in asked.METRICS:
        for who in asked.PRESETS:
            np.testing.assert_allclose(FOUND["marl_eval"][f"mean_{metric}"][who], asked.seeds_of(who)[metric])
