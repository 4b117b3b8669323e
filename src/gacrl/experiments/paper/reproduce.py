"""The paper's experiment: GACRL, QMIX, MAPPO and IPPO on the paper's schedule, several seeds of each.

Every pair of column and algorithm is a run folder of its own, so that a stopped reproduction goes on with what
is missing. What the runs showed is judged in `verdicts` and written down in `report`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, SupportsIndex

from gacrl.config import files as configuration
from gacrl.config import presets
from gacrl.config.checks import whole
from gacrl.config.run import EvaluationConfig, RunConfig
from gacrl.errors import UserError
from gacrl.experiments.paper import evidence
from gacrl.experiments.paper import report as reproduce_report
from gacrl.experiments.paper.claims import Judged
from gacrl.experiments.paper.verdicts import judge_all
from gacrl.experiments.study import Planned, Watch, claim_folder, refuse_other_settings, train_missing
from gacrl.tasks.spread.settings import SpreadSettings

Column = Literal["paper", "mpe2", "extended"]

EPISODES, HORIZON = 1_500, 75
ALGORITHMS: Mapping[str, str] = MappingProxyType(
    {"GACRL": "paper", "QMIX": "qmix", "MAPPO": "mappo", "IPPO": "ippo"}
)
"""The paper's names, and the presets that train them."""

EXTENDED: Mapping[str, str] = MappingProxyType(
    {"GACRL": "gacrl", "QMIX": "graph-qmix", "VDN": "graph-vdn", "MAPPO": "graph-mappo", "IPPO": "graph-ippo"}
)
"""The same as they should have been run, and VDN: torso, symmetry, reward, steps and parameters are equal."""

_PPO: dict[str, Any] = {"training": {"num_envs": 10, "num_steps": 25}, "algorithm": {"learning_rate": 2e-3}}
_AT_PAPER_BUDGET: Mapping[str, dict[str, Any]] = MappingProxyType(
    {
        "paper": {},
        "mappo": _PPO,
        "ippo": _PPO,
        "qmix": {
            "training": {"num_envs": 5, "num_steps": 15},
            "algorithm": {"updates": 10, "exploration_steps": 30_000, "network": {"width": 64}},
        },
    }
)
"""What differs from a preset that has millions of steps, where it gets the paper's 112,500."""


@dataclass(frozen=True)
class Reproduction:
    """A finished experiment and its report."""

    out: Path
    report: Path
    judged: tuple[Judged, ...]

    def to_dict(self) -> dict[str, Any]:
        return {
            "out": str(self.out),
            "report": str(self.report),
            "claims": {
                judged.claim.id: {"agreement": judged.base.agreement, "random": judged.base.chance}
                for judged in self.judged
            },
        }


def at_paper_budget(preset: str) -> RunConfig:
    """Return a preset with settings that suit the paper's number of steps, on MPE2's task with its 75-step episodes."""
    config = configuration.from_dict(_AT_PAPER_BUDGET[preset], presets.preset(preset))
    return replace(
        config,
        env=SpreadSettings(max_cycles=HORIZON),
        training=replace(config.training, env_steps=EPISODES * HORIZON),
        evaluation=EvaluationConfig(interval=50 * HORIZON, num_episodes=8),
    )


def in_column(config: RunConfig, column: Column) -> RunConfig:
    """Return the same with the column's reward: the paper's, and its curriculum; or MPE2's on an unchanging task."""
    if column != "paper":
        return config
    return replace(config, env=presets.preset("paper").env)


def plan(
    out: Path, seeds: int, episodes: int = EPISODES, extended: bool = False
) -> dict[tuple[Column, str], Planned]:
    """Return the runs of the experiment by column and algorithm, in the order in which they are made."""
    configs: dict[tuple[Column, str], RunConfig] = {}
    columns: tuple[Column, ...] = ("paper", "mpe2")
    for column in columns:
        for who, preset in ALGORITHMS.items():
            config = in_column(at_paper_budget(preset), column)
            training = replace(config.training, env_steps=episodes * HORIZON)
            configs[column, who] = replace(config, num_seeds=seeds, training=training)
    if extended:
        for who, preset in EXTENDED.items():
            configs["extended", who] = replace(presets.preset(preset), num_seeds=seeds)
    return {
        (column, who): Planned(f"{who}, {evidence.COLUMNS[column]}", config, out / f"{column}-{who.lower()}")
        for (column, who), config in configs.items()
    }


def reproduce(
    out: Path,
    seeds: SupportsIndex = 5,
    episodes: SupportsIndex = EPISODES,
    extended: bool = False,
    watch: Watch | None = None,
) -> Reproduction | None:
    """Train what is missing under `out`, judge every claim, write `report.html` and `report.md` there.

    Returns None where the watcher's stop ended it early. Raises UserError for fewer than two seeds, or a folder
    that holds something else.
    """
    watch, seeds, episodes = watch or Watch(), whole(seeds, "seeds"), whole(episodes, "episodes")
    out = out.absolute()
    if seeds < 2:
        raise UserError(f"--seeds must be at least 2, not {seeds}: with one there is no interval over seeds")
    if episodes < 1:
        raise UserError(f"--episodes must be at least 1, not {episodes}")
    planned = plan(out, seeds, episodes, extended)
    runs = list(planned.values())
    asked = {"seeds": seeds, "episodes": episodes}
    claim_folder(out, "reproduce.json", asked, "reproduction", _asked_before)
    refuse_other_settings(runs)
    watch.planned({run.name: "" for run in runs})
    if not train_missing(runs, watch):
        return None
    found = evidence.gather({place: run.folder for place, run in planned.items()}, out, watch.say)
    if ("paper", "GACRL") in found.diverged:
        raise UserError(f"there is nothing to compare with: GACRL's {found.diverged['paper', 'GACRL']}")
    judged = judge_all(found)
    watch.say("writing the report")
    report = reproduce_report.write(out, found, judged, seeds, episodes)
    return Reproduction(out, report, judged)


def _asked_before(held: Mapping[str, Any]) -> str:
    """What to say of a folder that holds another reproduction."""
    was = " and ".join(f"--{name} {value}" for name, value in held.items())
    return f"a reproduction with {was}: ask for the same, or choose another --out"
