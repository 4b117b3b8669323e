"""The record of a task: everything that training, evaluation, comparison and picture need to know of it.

A leaf: it imports no jax, so that names, metrics and settings can be asked for at once.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, NamedTuple, TypeAlias

from gacrl.errors import ConfigError

Settings: TypeAlias = Any
"""A frozen dataclass of numbers, strings and tuples."""
EnvParams: TypeAlias = Any
EnvState: TypeAlias = Any


class Metric(NamedTuple):
    """How one number of an episode comes from a measurement of its steps."""

    measure: str
    """A name in `TimeStep.info`."""
    over: Literal["mean", "sum", "last"] = "mean"
    """How the steps of an episode are reduced. What happened ever belongs into the state, and is taken last."""
    unit: str = ""
    higher_is_better: bool = True
    label: str = ""
    """A short name for tables. A metric without one is measured, and stays out of them."""
    defined_by: tuple[str, ...] = ()
    """Settings of the task that define it: where they differ it cannot be compared."""

    @property
    def sign(self) -> float:
        """Return what makes more of it better: 1 or −1."""
        return 1.0 if self.higher_is_better else -1.0

    @property
    def axis(self) -> str:
        """Return what the axis of a figure calls it: with its unit."""
        return with_unit(self.label or self.measure.replace("_", " "), self.unit)


def with_unit(name: str, unit: str) -> str:
    """Write a name with its unit, if there is one."""
    return f"{name} ({unit})" if unit else name


class Words(NamedTuple):
    """Names what a picture calls the things in it."""

    agent: str = "agent"
    mark: str = "place"
    lit: str = "reached"


class Part(NamedTuple):
    """Something that an ablation takes away: what is left, and the settings that change."""

    says: str
    changes: Mapping[str, Any]


class Team(NamedTuple):
    """How agents join and leave while a policy is watched. They fill the first of the places that there are."""

    least: Callable[[Settings], int]
    most: int
    room: Callable[[Settings, int], Settings]
    """(settings, N) -> the same task with places for N agents."""
    params: Callable[[Settings, EnvParams, int, int], EnvParams]
    """(settings as asked for, params of a room with masks, its places, agents that are there) -> params."""
    join: Callable[[Settings, EnvState, EnvState, int, int], EnvState]
    """(settings of the room, state, a fresh one, agents before, now) -> the state, newcomers as in the fresh one. It is
    compiled: the numbers of agents are traced."""


class Case(NamedTuple):
    """A task as the study of talk has it (`gacrl talk`)."""

    env_steps: int
    """Of each learner."""
    reached: str
    """The metric that is to reach .9."""
    settings: Mapping[str, Any] = MappingProxyType({})
    """What is set otherwise than usual."""
    utterances: Mapping[str, Any] | None = None
    """What is set where words are actions; None: the task has no such words."""
    moves_tell: bool = False
    """Silent agents see something that others did: silent ones with a memory are trained as well."""


def no_params(settings: Settings, gamma: float, padded: bool) -> EnvParams:
    """Return no numbers: nothing about the task could change between steps."""
    return ()


def unchanged(settings: Settings, params: EnvParams, share: Any) -> EnvParams:
    """Return the numbers as they are: the task is as difficult at the start as at the end."""
    return params


def complete(settings: Settings) -> bool:
    """Say that all agents are there from an episode's start to its end."""
    return False


def unnamed(settings: Settings) -> Sequence[str]:
    """Return no names: the task does not say what its actions are called."""
    return ()


SILENT, TOLD = "silent", "told"
"""Among a task's anchors: the best policy that says nothing, and one to which everything is told; mostly among its
references, too."""
MATTERS = 0.05
"""The share of a gain that counts: of what told agents gain, and of what learning gains at all."""
HEADLINE = "return_agent_mean"
RETURN: Mapping[str, Metric] = MappingProxyType(
    {
        HEADLINE: Metric("reward_raw", "sum", "reward per agent and episode", label="return"),
        "reward_raw": Metric("reward_raw", "mean"),
    }
)
"""Every task has these: the mean over agents of what they earn, summed over the episode, and per step."""


class Task(NamedTuple):
    """A task. Required: its name, the class of its settings, and how an environment is made of them."""

    name: str
    settings: type
    """A frozen dataclass of numbers, strings and tuples: what `--env.X` sets. It needs no jax."""
    make: Callable[[Settings], Any]
    """Settings -> Environment, which is hashable: masks and numbers that change belong into its params."""
    params: Callable[[Settings, float, bool], EnvParams] = no_params
    """(settings, the learner's γ, with room for absent agents) -> the numbers of the task."""
    difficulty: Callable[[Settings, EnvParams, Any], EnvParams] = unchanged
    """(settings, params, share in [0, 1]) -> the params there: what a curriculum moves."""
    metrics: Mapping[str, Metric] = RETURN
    """By name. A measure without a metric gets its mean; the return is always there."""
    headline: str = HEADLINE
    """Keeps the best policy, and leads tables and progress."""
    progress: str | None = None
    """A measure in [0, 1]: drives adaptive exploration and gates. None: exploration falls with time."""
    references: Mapping[str, Callable[[Any], Any]] = MappingProxyType({})
    """Scripted policies (Environment -> Actor) beside random and noop. The first is 1 in every score, where random is
    0, and stands in the tables; the others are played by name."""
    silent: str = SILENT
    """Among them the best policy that says nothing, where there is one."""
    told: str = TOLD
    """And the best that is told everything."""
    anchors: Path | None = None
    """A JSON file of committed scores of the headline: {scores: {random, silent, told}, settings, …} and where each is
    from. The scores are those of a task with these settings."""
    needs_memory: bool = False
    """What was seen or heard at earlier steps must be remembered."""
    needs_talk: bool = False
    """What an agent should do hangs on what others alone see: GACRL's critic is told it (`files.on_task`)."""
    scene: Callable[[Settings, EnvState, EnvParams], Any] | None = None
    """What a picture of a state shows (`gacrl.scene`). None: discs, where positions are known."""
    edit: Callable[[EnvState, Any], EnvState] | None = None
    """(state, `gacrl.scene.Edit`) -> the state after it: what a hand may move. None: nothing."""
    team: Team | None = None
    """None: always as many agents as the settings say."""
    world: Callable[[Any, EnvParams], Mapping[str, Any] | None] | None = None
    """(Environment, params) -> its rules as plain data, for a page that steps the task in JavaScript (`export/page`);
    None: such a page replays what was recorded."""
    ragged: Callable[[Settings], bool] = complete
    """Whether agents may be absent, or their lives end inside an episode."""
    comparable: tuple[str, ...] | None = None
    """Attributes of the settings that must be equal in one table; None: all."""
    words: Words = Words()
    uttered: Callable[[Any, Any], tuple[Any, Any]] | None = None
    """(Environment, policy that sends symbols) -> the environment in which words are actions, and the policy that
    utters its symbols there; None: the task has no such actions."""
    actions: Callable[[Settings], Sequence[str]] = unnamed
    """What each action does, by index: it stands beside an exported policy."""
    parts: Mapping[str, Part] = MappingProxyType({})
    """Parts of an ablation that this task alone has."""
    cases: Mapping[str, Case] = MappingProxyType({})
    """What the study of talk makes of it, by the names that it has there."""
    summary: str = ""
    """One line on what must be done, for `gacrl tasks`."""

    def metric(self, name: str) -> Metric:
        """Return the metric of that name; of a `score_` that of the number which it scales, and of a bare measure its
        mean.
        """
        plain = name.removeprefix("score_")
        found = self.metrics.get(plain) or RETURN.get(plain) or Metric(plain)
        return found._replace(higher_is_better=True) if plain != name else found

    def shown(self, measured: Sequence[str]) -> dict[str, str]:
        """Return the metrics of tables among those that are measured, headline first, and what they are called there.

        Of a task that defines no metrics all are shown.
        """
        bare = [name for name in measured if name not in RETURN] if self.metrics is RETURN else []
        named = {name: metric.label for name, metric in self.metrics.items() if metric.label}
        headline = {self.headline: self.metric(self.headline).label or self.headline}
        labels = {**headline, **named, **{name: name for name in bare}}
        return {name: label for name, label in labels.items() if name in measured}

    def numbers(self, settings: Settings, env: Any, gamma: float = 1.0, padded: bool = False) -> EnvParams:
        """Return what `params` says; where the record says nothing, what the environment has."""
        return env.default_params() if self.params is no_params else self.params(settings, gamma, padded)

    def with_horizon(self, settings: Settings, steps: int) -> Settings:
        """Return the settings with episodes of so many steps. Raises ConfigError where the task has a fixed length."""
        if "max_cycles" not in {field.name for field in fields(settings)}:
            raise ConfigError(f"{self.name} has no setting max_cycles: its episodes have a length of their own")
        return replace(settings, max_cycles=steps)

    def facts(self, settings: Settings, measured: Sequence[str]) -> dict[str, Any]:
        """Return what a comparison must know of the task as it is set, as plain data: it stands in every summary.

        measured: the names of the metrics that episodes have.
        """
        names = [field.name for field in fields(settings)] if self.comparable is None else self.comparable
        known = {**RETURN, **self.metrics}
        return {
            "name": self.name,
            "headline": self.headline,
            "shown": self.shown(measured),
            "scale": ["random", next(iter(self.references))] if self.references else None,
            "units": {name: metric.unit for name, metric in known.items() if metric.unit},
            "lower_is_better": [name for name, metric in known.items() if not metric.higher_is_better],
            "defined_by": {name: list(metric.defined_by) for name, metric in known.items() if metric.defined_by},
            "comparable": {name: getattr(settings, name) for name in names},
            "talk": self._talk(settings),
        }

    def known(self) -> dict[str, Any]:
        """Read the anchors; nothing where there are none. Raises ConfigError for a damaged file."""
        if self.anchors is None or not self.anchors.exists():
            return {}
        try:
            known = json.loads(self.anchors.read_text(encoding="utf-8"))
            return {**known, "scores": {**known["scores"]}, "settings": {**known.get("settings", {})}}
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ConfigError(
                f"{self.anchors}, the anchors of {self.name}, must be a JSON object with scores: {error}"
            ) from error

    def _talk(self, settings: Settings) -> dict[str, float] | None:
        """Return the headline of the best silent and of a told policy.

        None where the anchors are of other settings, or being told is worth too little for a scale.
        """
        known = self.known()
        random, silent, told = (known.get("scores", {}).get(who) for who in ("random", SILENT, TOLD))
        anchored = known.get("settings", {})
        same = all(getattr(settings, name, None) == value for name, value in anchored.items())
        if not anchored or not same or silent is None or told is None:
            return None
        slight = random is not None and abs(told - silent) <= MATTERS * abs(silent - random)
        return None if slight else {SILENT: silent, TOLD: told}
