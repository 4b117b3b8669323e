"""Where a run stands, in one line: for terminals, notebooks and logs."""

import sys
from typing import Any

import numpy as np

from gacrl.config import presets
from gacrl.config.run import RunConfig
from gacrl.training.build import Plan
from gacrl.training.loop import Progress
from gacrl.training.recorder import RunFolder
from gacrl.training.watching import Watcher


def standing(progress: Progress) -> str:
    """Say where a run stands after an evaluation: greedy play, the mean over the seeds."""
    told = [f"step {progress.env_steps:,} of {progress.total_env_steps:,}"]
    for name, label in progress.shown.items():
        values = [row["greedy"][name] for row in progress.rows if name in row["greedy"]]
        told += [f"{label} {np.mean(values):.3g}"] if values else []
    if progress.done:
        return "  ".join(told)
    return "  ".join(
        [*told, f"{progress.clock.steps_per_second:,.0f} steps/s", f"{progress.seconds_left:.0f} s left"]
    )


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
