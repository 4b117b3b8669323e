"""Who plays on a live page, and in what: one policy or two of the same task, named on the command line alone."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from threading import Lock
from typing import Any, NamedTuple, TypeAlias

import jax

from gacrl import play, tasks
from gacrl.config.checks import require
from gacrl.envs.environment import EnvParams
from gacrl.errors import UserError
from gacrl.evaluation import references
from gacrl.export.html import UNBOUNDED
from gacrl.export.replays import STEPS
from gacrl.networks.agent import AgentNetwork
from gacrl.networks.communication import kind_of
from gacrl.play import TrainedRun
from gacrl.tasks.task import Task
from gacrl.training import build
from gacrl.training.devices import one_seed
from gacrl.training.trainer import AbstractTrainer
from gacrl.types import Learner, Policy
from gacrl.viewer.hosted import HostRoom
from gacrl.viewer.requests import Bounds
from gacrl.viewer.rooms import Customs, Playable, Room

_LADDER = (32,)
"""Places of the rooms for other numbers of agents than the task's own; the largest has the most that may come."""

AnyRoom: TypeAlias = Room | HostRoom
Change = Callable[[Any], Any]
Warn = Callable[[str], None]


class Player:
    """A policy, its newest parameters, and the rooms that it plays in, each made when it is first needed."""

    def __init__(
        self, name: str, task: Task, settings: Any, make: Callable[[Any], Playable], learner: Learner
    ) -> None:
        """make: settings of the task -> the policy in it."""
        self.name, self.task, self.settings, self._make = name, task, settings, make
        self.learner, self.env_steps = learner, 0
        self.sampled = False
        """It draws what it does."""
        self.draws = False
        """Its head says how likely each action is, and not what it is worth."""
        self.opened: TrainedRun | None = None
        """None for a scripted policy."""
        self.nearest: int | None = None
        """So many neighbours an agent listens to at the most; None: all."""
        self.reach: float | None = None
        """The radius within which agents hear each other; None where that is not how they do."""
        self.most: int | None = None
        """Agents that it can play with at the most; None: the task says."""
        self.vocabulary = 0
        """Symbols that it says; 0 for one that says none."""
        self._rooms: dict[int, AnyRoom] = {}
        self._params: dict[tuple[int, int], EnvParams] = {}
        self._making = Lock()
        self.home = int(task.make(settings).num_agents)
        """As many agents as the task itself has."""

    @property
    def team(self) -> tuple[int, int]:
        """How few and how many agents it can play with."""
        team = self.task.team
        if team is None or (self.most is not None and self.most <= self.home):
            return self.home, self.home
        most = team.most if self.most is None else min(self.most, team.most)
        return min(team.least(self.settings), self.home), max(most, self.home)

    def places(self, count: int) -> int:
        """Return the size of the room in which so many agents begin: the task's own has no place to spare."""
        return count if count == self.home else self.places_beside(count)

    def places_beside(self, count: int) -> int:
        """Return the size of the room in which so many agents are, and others may come or go."""
        return next(size for size in self.sizes[1:] if size >= count)

    @property
    def sizes(self) -> tuple[int, ...]:
        """The sizes of all its rooms: the task's own first."""
        least, most = self.team
        if least == most:
            return (self.home,)
        return self.home, *(size for size in _LADDER if size < most), most

    def room(self, places: int) -> AnyRoom:
        """Return the room of that size; nobody waits for one that is there while another is made."""
        if (found := self._rooms.get(places)) is not None:
            return found
        with self._making:
            if places not in self._rooms:
                self._rooms[places] = self._furnished(places)
            return self._rooms[places]

    def _furnished(self, places: int) -> AnyRoom:
        settings, task = self.sized(places), self.task
        customs = Customs(
            look=references.look_of(task, settings),
            measures=tuple(dict.fromkeys(self.measures.values())),
            edit=task.edit,
            join=None if task.team is None else partial(task.team.join, settings),
            reach=self.reach is not None and task.team is not None,
            nearest=self.nearest,
        )
        playable = self._make(settings)
        room = (HostRoom if playable.env.hosted else Room)(playable, customs)
        room.measure(self.learner, self.params(places, places))
        return room

    @property
    def summed(self) -> set[str]:
        """The measurements that are added up over an episode."""
        return {metric.measure for metric in self.task.metrics.values() if metric.over == "sum"}

    @cached_property
    def measures(self) -> dict[str, str]:
        """What a page shows of each step besides the reward: {what it is called there: measurement}."""
        return {**self.world.get("measures", {})}

    @cached_property
    def world(self) -> Mapping[str, Any]:
        """The rules of the task, as an exported page has them; {} where it would know none."""
        known = self.task.world
        found = None if known is None else known(self.task.make(self.settings), self.params(self.home, self.home))
        return {} if found is None else found

    def params(self, places: int, count: int) -> EnvParams:
        """Return the numbers of the task in the room of that size, with so many agents there."""
        if (places, count) not in self._params:
            self._params[places, count] = self._counted(places, count)
        return self._params[places, count]

    def _counted(self, places: int, count: int) -> EnvParams:
        settings, team = self.sized(places), self.task.team
        env = self.task.make(settings)
        if places == count == self.home or team is None:
            return self.task.numbers(settings, env)
        return team.params(self.settings, self.task.numbers(settings, env, 1.0, True), places, count)

    def sized(self, places: int) -> Any:
        """Return the settings of the room of that size."""
        team = self.task.team
        return self.settings if places == self.home or team is None else team.room(self.settings, places)


class Cast(NamedTuple):
    """One player, or two side by side, and what a page must know of them."""

    players: tuple[Player, ...]
    bounds: Bounds

    @property
    def task(self) -> Task:
        """What is played."""
        return self.players[0].task

    @property
    def settings(self) -> Any:
        """The task as it is set."""
        return self.players[0].settings


def open_cast(
    names: Sequence[str],
    task: str = tasks.DEFAULT,
    change: Change = lambda settings: settings,
    sampled: bool = False,
    warn: Warn = lambda sentence: None,
) -> Cast:
    """Open the policies of these names: runs, pretrained:NAME, or scripted policies of the task.

    task: what scripted policies play where no run says it. The first run's task and settings, changed, are everyone's.
    Raises UserError for names that are nobody's, policies that do not play the same task, or a task that cannot be
    shown.
    """
    require(1 <= len(names) <= 2, f"a page shows one policy or two, not {len(names)}")
    known = references.playable(tasks.find(task))
    first = next((name for name in names if name not in known and not _only_scripted(name)), None)
    runs = {} if first is None else {first: play.open_one(first, change, warn)}
    if first is None:
        found, settings = tasks.find(task), change(tasks.default_settings(task))
    else:
        found, settings = runs[first].task, runs[first].config.env
    _require_shown(found, settings)
    players = tuple(_player(name, found, settings, runs, sampled, warn) for name in names)
    return Cast(players, _bounds(players))


def _only_scripted(name: str) -> bool:
    """Whether this is the name of no run, but of a scripted policy of some task: it may be the run's."""
    scripts = (references.playable(tasks.find(task)) for task in tasks.names())
    return not Path(name).exists() and any(name in script for script in scripts)


def _require_shown(task: Task, settings: Any) -> None:
    env = task.make(settings)
    if env.hosted:
        return  # it draws itself, or says later that it cannot
    seen = jax.eval_shape(env.reset, jax.random.key(0), task.numbers(settings, env))[1]
    if task.scene is None and seen.positions is None:
        raise UserError(f"{task.name} does not say where things are: give its observations positions, or a scene")


def _player(
    name: str, task: Task, settings: Any, runs: Mapping[str, TrainedRun], sampled: bool, warn: Warn
) -> Player:
    """Open one policy. runs: those that are open already."""
    if name in runs:
        return trained(runs[name], name, sampled)
    if name in references.playable(task):
        return scripted(name, task, settings)
    require(bool(runs), f"{name} is no policy of {task.name}: name its task with --env TASK")
    require(
        play.folder_of(name).config().task == task.name,
        f"{name} does not play {task.name}: two policies side by side need the same task",
    )
    return trained(play.open_one(name, lambda _: settings, warn), name, sampled)


def scripted(name: str, task: Task, settings: Any) -> Player:
    """Return a policy that learns nothing."""

    def make(settings: Any) -> Playable:
        env = task.make(settings)
        actor = references.actor(task, name, env)
        return Playable(env, lambda learner: actor.policy, actor.initial_memory)

    return Player(name, task, settings, make, ())


def trained(opened: TrainedRun, name: str, sampled: bool = False) -> Player:
    """Return the first seed of a run, playing greedily unless it is `sampled`."""

    def make(settings: Any) -> Playable:
        trainer = build.make_trainer(replace(opened.config, env=settings), learns=False)
        env, algorithm = trainer.evaluation_env, trainer.algorithm
        structure = jax.tree.structure(_acts(trainer))  # it knows its environment, and so is each room's own

        def policy(numbers: Learner) -> Policy:
            return algorithm.policy(jax.tree.unflatten(structure, numbers), sampled)

        def network(numbers: Learner) -> AgentNetwork:
            assert algorithm.network is not None
            return algorithm.network(jax.tree.unflatten(structure, numbers))

        return Playable(env, policy, trainer.memory, None if algorithm.network is None else network)

    player = Player(name, opened.task, opened.config.env, make, acting(opened))
    player.opened, player.env_steps, player.sampled = opened, opened.env_steps, sampled
    player.draws = opened.trainer.algorithm.draws
    network = getattr(opened.config.algorithm, "network", None)
    if network is not None:
        player.nearest, player.reach = network.nearest_agents, network.radius
        player.vocabulary = network.vocabulary if kind_of(network).sends_symbols else 0
    if not _resizes(opened):
        player.most = player.home
    elif player.nearest is None:
        player.most = max(UNBOUNDED, player.home)
    return player


def acting(opened: TrainedRun) -> list[jax.Array]:
    """Return the numbers with which the first seed acts, as they are without a mesh of devices."""
    return jax.device_put(jax.device_get(jax.tree.leaves(one_seed(opened.learners, 0))))


def _acts(trainer: AbstractTrainer) -> Learner:
    """Return the shapes of what acts, of one seed."""
    algorithm = trainer.algorithm
    return algorithm.acting(jax.eval_shape(lambda: algorithm.init(jax.random.key(0), algorithm.hyper)))


def _resizes(opened: TrainedRun) -> bool:
    """Whether the same parameters play with other numbers of agents."""
    team, settings = opened.task.team, opened.config.env
    if team is None or getattr(opened.config.algorithm, "fixed_team", False):
        return False
    other = replace(opened.config, env=team.room(settings, opened.env.num_agents + 1))
    one, two = (jax.tree.leaves(_acts(it)) for it in (opened.trainer, build.make_trainer(other, learns=False)))
    return [leaf.shape for leaf in one] == [leaf.shape for leaf in two]


def _bounds(players: tuple[Player, ...]) -> Bounds:
    first = players[0]
    least = max(player.team[0] for player in players)
    most = min(player.team[1] for player in players)
    said = [player.room(player.home).words for player in players]
    return Bounds(
        least=least,
        most=most,
        length=min(int(first.task.make(first.settings).max_cycles), STEPS),
        rounds=max(0 if words is None else words[0] for words in said),
        vocabulary=max(player.vocabulary for player in players),
        movable=first.task.edit is not None,
        reach=first.task.team is not None and any(player.reach is not None for player in players),
    )
