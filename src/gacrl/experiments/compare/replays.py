"""Episodes of the closing evaluation to look at: of each group the best, the median and the worst ones.

Loads jax: import it where a page was asked for.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from gacrl import tasks
from gacrl.config.checks import require
from gacrl.errors import UserError
from gacrl.evaluation import episodes as recording
from gacrl.evaluation.episodes import Played
from gacrl.experiments.compare.compare import Comparison
from gacrl.experiments.compare.finished import Warn
from gacrl.experiments.compare.groups import Group
from gacrl.export import replays
from gacrl.play import open_run
from gacrl.training.devices import one_seed
from gacrl.training.trainer import Trainer

WORST = 20
_ROOM = 256 * 2**20
"""Bytes that the episodes of a seed may take while they are played."""
_MOST_BYTES = 8_000_000
"""Of all replays of a page."""


class Gallery(NamedTuple):
    """What there is to see of a group."""

    name: str
    shown: list[dict[str, Any]]
    """Episodes as plain data: {rank, seed, number, value, replay}, the best one first; none: see `because`."""
    of: int = 0
    """How many episodes they were chosen from."""
    closing: bool = True
    """Whether they are all of the closing evaluation; fewer, for want of memory, have starts of their own."""
    because: str = ""
    """Why there is nothing."""


class _Place(NamedTuple):
    """An episode: its rank in words, the seed's place among all of its group, and its number there."""

    rank: str
    seed: int
    number: int


@dataclass(frozen=True)
class _Seeds:
    """The seeds of a group, each with its learner, and what plays them."""

    names: tuple[int, ...]
    learners: tuple[Any, ...]
    trainer: Trainer
    episodes: int
    explore: bool

    def played(self, seed: int) -> Played:
        """Return the closing evaluation of a seed, by its place."""
        return self.trainer.record(self.learners[seed], "report", self.episodes, self.explore)


def record(comparison: Comparison, tell: Warn) -> list[Gallery]:
    """Play the closing evaluations again and keep the best, the median and the 20 worst episodes of each group.

    tell: hears what takes time. A group that cannot be shown says why.
    """
    return [_gallery(group, comparison, tell) for group in comparison.groups]


def data(comparison: Comparison, galleries: Sequence[Gallery]) -> dict[str, Any]:
    """Return what the page's player needs: `export/page/report.js`."""
    config = comparison.groups[0].config
    task = tasks.find(config.task)
    return {
        "groups": [{"name": it.name, "episodes": it.shown} for it in galleries if it.shown],
        "words": {"agent": task.words.agent, "mark": task.words.mark, "lit": task.words.lit},
        "actions": list(task.actions(config.env)),
        "colours": replays.COLOURS,
        "measure": "return",
    }


def chosen(returns: Float[np.ndarray, "S K"]) -> list[_Place]:
    """Return where the best, the median and the worst episodes are, in this order; none of them twice."""
    order = np.argsort(returns, axis=None, kind="stable")
    ranks = {"best": order[-1], "median": order[(order.size - 1) // 2]}
    ranks |= {f"worst {k + 1}": place for k, place in enumerate(order[:WORST])}
    found: dict[int, str] = {}
    for rank, place in ranks.items():
        found.setdefault(int(place), rank)
    return [_Place(rank, *divmod(place, returns.shape[1])) for place, rank in found.items()]


def _gallery(group: Group, comparison: Comparison, tell: Warn) -> Gallery:
    try:
        seeds = _seeds(group, comparison)
        tell(f"playing {seeds.episodes} episodes of each of {len(seeds.names)} seeds of {group.name} for the page")
        returns = np.stack([_returns(seeds.played(seed)) for seed in range(len(seeds.names))])
        shown = _recorded(seeds, returns)
    except UserError as error:
        return Gallery(group.name, [], because=str(error))
    sizes = np.cumsum([len(json.dumps(it)) for it in shown])
    kept = int((sizes <= _MOST_BYTES // len(comparison.groups)).sum())
    return Gallery(group.name, shown[: max(kept, 1)], returns.size, seeds.episodes == comparison.episodes)


def _seeds(group: Group, comparison: Comparison) -> _Seeds:
    """Open the runs of a group. Raises UserError, with why, where they cannot be shown."""
    ended = [run for run in group.members if run.diverged is None]
    require(bool(ended), "it diverged")
    task = tasks.find(group.config.task)

    def change(settings: Any) -> Any:
        horizon = getattr(settings, "max_cycles", None)
        return (
            settings if horizon in (None, comparison.horizon) else task.with_horizon(settings, comparison.horizon)
        )

    opened = [open_run(run.path, change) for run in ended]
    trainer = opened[0].trainer
    if not isinstance(trainer, Trainer):
        raise UserError(f"{task.name} lives in Python and draws itself: it has no scene")
    room = recording.recorded_bytes(trainer.evaluation_env, trainer.evaluation_params, 1, trainer.look)
    return _Seeds(
        tuple(seed for run in ended for seed in run.config.seeds),
        tuple(one_seed(run.learners, member) for run in opened for member in range(run.config.num_seeds)),
        trainer,
        int(np.clip(_ROOM // room, 1, comparison.episodes)),
        comparison.play == "sampled",
    )


def _returns(played: Played) -> Float[np.ndarray, " K"]:
    """The return of each episode up to its end."""
    rewards, done = np.asarray(played.reward_raw, float), np.asarray(played.done)
    return np.where(done.cumsum(0) - done == 0, rewards, 0.0).sum(0)


def _recorded(seeds: _Seeds, returns: Float[np.ndarray, "S K"]) -> list[dict[str, Any]]:
    """Play the seeds that the chosen episodes are of once more, and keep those. Raises UserError without a scene."""
    places = chosen(returns)
    shown: dict[_Place, dict[str, Any]] = {}
    for seed in {place.seed for place in places}:
        episodes = recording.cut(seeds.played(seed))
        require(
            episodes[0].scene is not None,
            "its task does not say where things are: it has no scene, and no positions",
        )
        for place in places:
            if place.seed == seed:
                shown[place] = replays.replay([episodes[place.number]])[0]
    return [
        {
            "rank": place.rank,
            "seed": seeds.names[place.seed],
            "number": place.number,
            "value": round(float(returns[place.seed, place.number]), 4),
            "replay": shown[place],
        }
        for place in places
    ]
