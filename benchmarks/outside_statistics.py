"""What rliable and marl-eval make of our results: kept, so that a test holds our own statistics against them.

    python -m venv .peers
    .peers/bin/pip install rliable==1.2.0 "pandas<3" "arch<7.3" seaborn tqdm matplotlib colorama
    .peers/bin/pip install --no-deps id-marl-eval==0.0.4
    PYTHONPATH=src .peers/bin/python benchmarks/outside_statistics.py

Reads every seed's values of docs/data/{mappo,ippo,vdn,qmix}-5-seeds.json and writes tests/evaluation/outside.json. The
packages are no dependency: they bring 165 MB, and marl-eval asks for a pandas that Python 3.11 has no build of.
"""

import hashlib
import json
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).parents[1]
PRESETS = ("mappo", "ippo", "vdn", "qmix")
METRICS = ("return_agent_mean", "coverage_final_0.1")
REPS = 50_000


def seeds_of(preset: str) -> dict[str, list[float]]:
    """Every seed's value of each metric, and the steps that it was trained for."""
    data = json.loads((ROOT / "docs" / "data" / f"{preset}-5-seeds.json").read_text(encoding="utf-8"))
    return {metric: data["final"]["greedy"][metric]["values"] for metric in METRICS}


def exported() -> dict[str, Any]:
    """These runs in marl-eval's form, by our own export."""
    from gacrl.experiments.compare.marl_eval import EvaluatedRun, to_marl_eval

    runs: list[EvaluatedRun] = []
    for preset in PRESETS:
        values = seeds_of(preset)
        for seed in range(len(values[METRICS[0]])):
            final = {metric: [values[metric][seed]] for metric in METRICS}
            along = {metric: [[value[0]]] for metric, value in final.items()}
            runs.append(EvaluatedRun("spread", "3_agents", preset, f"seed_{seed}", [1_000_000], along, final))
    return to_marl_eval(runs)


def digest(data: dict[str, Any]) -> str:
    """Of an export, by which a test knows that marl-eval has read this one."""
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()


def by_rliable() -> dict[str, Any]:
    """Points and 95 % intervals of rliable's stratified bootstrap."""
    from rliable import library, metrics

    scores = {preset: np.array([seeds_of(preset)[metric] for metric in METRICS]).T for preset in PRESETS}
    aggregates: dict[str, Callable[[np.ndarray], float]] = {
        "iqm": metrics.aggregate_iqm,
        "mean": metrics.aggregate_mean,
        "median": metrics.aggregate_median,
    }

    def estimated(values: dict[str, Any], function: Callable[..., float]) -> dict[str, list[float]]:
        points, bounds = library.get_interval_estimates(
            values, lambda *given: np.array([function(*given)]), reps=REPS, random_state=np.random.RandomState(0)
        )
        return {name: [float(points[name][0]), *map(float, np.ravel(bounds[name]))] for name in values}

    alone = {f"{who}/{m}": values[:, k : k + 1] for who, values in scores.items() for k, m in enumerate(METRICS)}
    pairs = {f"{a}/{b}": (scores[a], scores[b]) for a, b in (("mappo", "ippo"), ("qmix", "vdn"), ("ippo", "qmix"))}
    return {
        "each metric, iqm": estimated(alone, metrics.aggregate_iqm),
        **{f"both metrics, {name}": estimated(scores, function) for name, function in aggregates.items()},
        "probability of improvement": estimated(pairs, metrics.probability_of_improvement),
    }


def by_marl_eval(data: dict[str, Any]) -> dict[str, dict[str, list[float]]]:
    """The closing evaluation of every run, as marl-eval reads it from our export: by metric and algorithm."""
    from marl_eval.utils import data_processing_utils as processing

    processed = processing.data_process_pipeline(data, [])
    matrices, _ = processing.create_matrices_for_rliable(processed, "spread", [])
    return {
        metric: {algorithm: np.ravel(values).tolist() for algorithm, values in found.items()}
        for metric, found in matrices.items()
    }


def main() -> None:
    """Write tests/evaluation/outside.json anew."""
    data = exported()
    found = {
        "command": "PYTHONPATH=src .peers/bin/python benchmarks/outside_statistics.py",
        "versions": {
            name: metadata.version(name) for name in ("rliable", "id-marl-eval", "arch", "pandas", "numpy")
        },
        "reps": REPS,
        "rliable": by_rliable(),
        "export": digest(data),
        "marl_eval": by_marl_eval(data),
    }
    (ROOT / "tests" / "evaluation" / "outside.json").write_text(
        json.dumps(found, indent=1) + "\n", encoding="utf-8"
    )


if __name__ == "__main__":
    main()
