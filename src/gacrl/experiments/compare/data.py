"""A comparison as plain data: ours, and marl-eval's."""

from collections.abc import Sequence
from typing import Any

from gacrl.evaluation.statistics import Difference, Estimate
from gacrl.experiments.compare import marl_eval
from gacrl.experiments.compare.compare import Comparison, Group


def to_dict(comparison: Comparison) -> dict[str, Any]:
    """The comparison as plain data: every seed's value, every interval."""
    names = [group.name for group in comparison.groups]
    return {
        "play": comparison.play,
        "statistic": "iqm",
        "episodes": comparison.episodes,
        "horizon": comparison.horizon,
        "groups": [_group_data(group, comparison.metrics) for group in comparison.groups],
        "references": {
            who: {metric: comparison.reference(who, metric) for metric in comparison.metrics}
            for who in comparison.references
        },
        "pairs": [
            {
                "a": pair.a,
                "b": pair.b,
                "metric": pair.metric,
                "difference": pair.point,
                "interval": _bounds(pair.difference),
                "detectable": None if pair.difference is None else pair.difference.detectable,
                "verdict": pair.verdict,
                "equivalence": None if pair.equivalence is None else pair.equivalence._asdict(),
                "probability_of_improvement": None if pair.better is None else pair.better.point,
                "probability_of_improvement_interval": _bounds(pair.better),
                "claimed": pair.claimed,
            }
            for pair in comparison.pairs
        ],
        "config_differences": {
            name: dict(zip(names, values, strict=True)) for name, values in comparison.config_differences.items()
        },
        "unequal_switches": list(comparison.unequal_switches),
        "notes": list(comparison.notes),
    }


def to_marl_eval(comparison: Comparison) -> dict[str, Any]:
    """The runs as marl-eval's raw data: a mean over the episodes of each evaluation."""
    config = comparison.groups[0].config
    agents = getattr(config.env, "num_agents", None)
    task = f"{comparison.horizon}_steps" if agents is None else f"{agents}_agents_{comparison.horizon}_steps"
    return marl_eval.to_marl_eval(
        [
            marl_eval.EvaluatedRun(
                environment=config.task,
                task=task,
                algorithm=group.name,
                run=f"seed_{seed}",
                env_steps=group.evaluated_at,
                metrics={name: [[value] for value in values[k]] for name, values in group.along.items()},
                absolute={name: [values[k]] for name, values in group.final.items()},
            )
            for group in comparison.groups
            for k, seed in enumerate(group.seeds)
        ]
    )


def _group_data(group: Group, metrics: Sequence[str]) -> dict[str, Any]:
    return {
        "name": group.name,
        "runs": list(group.runs),
        "seeds": list(group.seeds),
        "env_steps": list(group.evaluated_at),
        "metrics": {
            metric: {
                "point": group.point(metric),
                "interval": _bounds(group.estimate(metric)),
                "values": group.final[metric].tolist(),
                "along": group.along[metric].tolist(),
            }
            for metric in metrics
        },
    }


def _bounds(found: Estimate | Difference | None) -> list[float] | None:
    return None if found is None else [found.low, found.high]
