"""Runs that were evaluated over other horizons, played again over one, so that they can stand in one table.

Loads jax: import it where a horizon was asked for.
"""

from typing import Any

from gacrl import tasks
from gacrl.experiments import scoring
from gacrl.experiments.compare.finished import Finished, Warn
from gacrl.versions import versions


def played_again(run: Finished, horizon: int, warn: Warn) -> Finished:
    """Return the run with the closing evaluation that `gacrl evaluate RUN --horizon` makes: same policies, same starts.

    It has as many episodes as its own, and no evaluations along the way: those were over another horizon. Raises
    ConfigError for a task whose episodes have a length of their own.
    """

    def change(settings: Any) -> Any:
        return tasks.find(run.config.task).with_horizon(settings, horizon)

    warn(f"playing {run.path} again, over {horizon} steps")
    scores = scoring.score_run(str(run.path), run.summary["episodes"], change, warn=warn)
    measured = {name: scores[name] for name in ("final", "references", "episodes", "horizon")}
    return run._replace(summary={**run.summary, **measured, "versions": versions()}, facts=scores["task"], rows=[])
