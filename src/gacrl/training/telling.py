"""Where a run stands, in one line: for terminals, notebooks and logs."""

import sys
from typing import Any

from gacrl.config import presets
from gacrl.config.run import RunConfig
from gacrl.report.screen import duration
from gacrl.tasks.task import HEADLINE
from gacrl.training.build import Plan
from gacrl.training.loop import Progress
from gacrl.training.recorder import RunFolder
from gacrl.training.watching import Watcher

_ON_A_LINE = 2
"""Metrics of a line."""


def standing(progress: Progress) -> str:
    """Write in one line where a run stands: what its greedy evaluation reached, its pace, and the time to its end."""
    done = progress.rows[0]["episodes_done"]
    episodes = f"episode {done:,}" if done else "no episode has ended"
    return (
        f"step {progress.env_steps:,} of {progress.total_env_steps:,}, {episodes}: {reached(progress)}; "
        f"{progress.clock.steps_per_second:,.0f} steps/s, {duration(progress.seconds_left)} left"
    )


def reached(progress: Progress) -> str:
    """Write what a greedy evaluation reached, as the closing table does: headline first, return, means over seeds."""
    rows, headline = progress.rows, next(iter(progress.shown), HEADLINE)
    names = [name for name in dict.fromkeys((headline, HEADLINE, *progress.shown)) if name in rows[0]["greedy"]]
    means = {name: sum(row["greedy"][name] for row in rows) / len(rows) for name in names[:_ON_A_LINE]}
    told = [f"{progress.shown.get(name, 'return')} = {mean:.3f}" for name, mean in means.items()]
    return f"greedy {', '.join(told)}" + (f" (mean of {len(rows)} seeds)" if len(rows) > 1 else "")


def teller(config: RunConfig) -> Watcher:
    """Return a watcher that prints a line on standard error for every evaluation, and where the run lies."""

    def tell(line: str) -> None:
        print(line, file=sys.stderr, flush=True)

    def planned(folder: RunFolder, config: RunConfig, plan: Plan) -> None:
        tell(f"{folder.path}: {presets.label(config)} on {config.task}, {plan.parameters:,} parameters")
        for note in plan.notes:
            tell(note)

    def finished(summary: dict[str, Any]) -> None:
        tell(f"done in {summary['wall_seconds']:.0f} s" if summary else "done")

    return Watcher(
        planned=planned,
        compiling=lambda: tell("compiling the training program"),
        progress=lambda progress: tell(standing(progress)),
        finishing=lambda: tell("closing evaluation"),
        finished=finished,
        warn=tell,
    )
