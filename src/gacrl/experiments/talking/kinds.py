"""Who learns in the study of talk: every kind of message around one learner, and other learners with symbols.

All have about as many parameters as the learner that sends symbols, and its switches; what differs is said here.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache, partial
from types import MappingProxyType
from typing import Any, NamedTuple

from gacrl import tasks
from gacrl.algorithms.actions import choices
from gacrl.algorithms.distributions import distribution
from gacrl.config import files as configuration
from gacrl.config import presets
from gacrl.config.algorithms import NetworkConfig, PpoConfig
from gacrl.config.kinds import COMMUNICATION
from gacrl.config.run import RunConfig
from gacrl.errors import UserError
from gacrl.networks.agent import acting_parameters, matched
from gacrl.networks.communication import kind_of
from gacrl.networks.communication.symbols import Symbols
from gacrl.tasks.task import Case

NONE, REMEMBERING, TOLD, SYMBOLS, UTTERED = "none", "none-recurrent", "told", "discrete", "actions"
SILENT_KINDS = (NONE, REMEMBERING)
"""Who says nothing: the better one is the floor of a score."""
KIND_OF: Mapping[str, str] = MappingProxyType({"silent": NONE, "talking": SYMBOLS, "told": TOLD})
"""Of the three learners that answer for one task."""
EVALUATIONS = 16
CLOSING_EPISODES = 512
"""Whatever is compared at the end plays as many."""
_WINDOW = 8
"""Steps of a replayed window where something is carried from step to step, as the preset `dial` has it."""


@dataclass(frozen=True)
class Base:
    """What the learners of a case share."""

    case: Case
    talking: RunConfig
    """The learner that sends symbols."""
    parameters: int
    """Of its acting network."""


class Kind(NamedTuple):
    """A column of the study."""

    says: str
    settings: Callable[[Base], RunConfig | None]
    """None: the task has nothing for it."""


def base(config: RunConfig, case: Case, seeds: int, scale: float) -> Base:
    """Settle what the learners of a case share.

    config: of the learner, on the task of the case. scale: of the steps. Raises UserError for a preset whose agents
    cannot choose what they send, and for a task of one agent.
    """
    config = replace(config, env=configuration.changed(config.env, case.settings))
    env_steps = max(round(case.env_steps * scale), 1)
    talking = talker(config, seeds, env_steps, env_steps // EVALUATIONS)
    return Base(case, talking, num_parameters(talking))


def talker(config: RunConfig, seeds: int, env_steps: int, interval: int) -> RunConfig:
    """Return the settings of the learner with symbols, whose critic is told. Raises UserError for what cannot talk."""
    if getattr(config.algorithm, "network", None) is None:
        raise UserError(
            f"--preset {config.preset} has a network of its own: name one whose messages can be chosen"
        )
    if tasks.find(config.task).make(config.env).num_agents < 2:
        raise UserError(f"{config.task} has a single agent: nobody is there to talk to")
    if getattr(config.env, "talk", None) == "actions":
        raise UserError(
            f"{config.task} has words among its actions there, and no messages that could be silenced: leave "
            "--env.talk out"
        )
    changes = {
        "num_seeds": seeds,
        "algorithm": {"network": {"communication": SYMBOLS}},
        "training": {"env_steps": env_steps},
        "evaluation": {"interval": max(interval, 1)},
    }
    return configuration.with_critic(configuration.from_dict(changes, config), "told")


def num_parameters(config: RunConfig) -> int:
    """Count the parameters of the acting network."""
    return _counted(config.task, config.env, config.algorithm.network, isinstance(config.algorithm, PpoConfig))


@cache
def _counted(task: str, settings: Any, network: NetworkConfig, draws: bool) -> int:
    """The same, once a process: a width is searched for. draws: actions are drawn, and may be numbers."""
    env = tasks.find(task).make(settings)
    actions = (distribution(env).actions if draws else choices(env)).size
    return acting_parameters(env, matched(env, network, actions), actions)


def sends(communication: str, shared: Base) -> RunConfig:
    """Return the learner with another kind of messages, or with none."""
    return hears_by(communication, shared.talking, shared.parameters)


def hears_by(communication: str, talking: RunConfig, parameters: int) -> RunConfig:
    """Return the settings with other messages, as many parameters, and nothing that goes with symbols alone.

    A critic that is told teaches to talk within a step: silent agents, told ones and those who hear late have a central
    one.
    """
    network: dict[str, Any] = {"communication": communication}
    if communication != talking.algorithm.network.communication:
        network["parameters"] = parameters
    kind = kind_of(replace(talking.algorithm.network, communication=communication))
    if not issubclass(kind, Symbols):
        network |= {"gate": False, "word_price": 0.0}
    changed = configuration.from_dict({"algorithm": {"network": network}}, talking)
    if kind.heard_late:
        changed = in_windows(changed)
    untaught = communication in (NONE, TOLD) or kind.heard_late
    return configuration.with_critic(changed, "central") if untaught else changed


def in_windows(config: RunConfig) -> RunConfig:
    """Replay windows, in as many steps altogether, so that a gradient reaches back in time."""
    if getattr(config.algorithm, "sequence_length", _WINDOW) >= _WINDOW:
        return config
    windows = max(config.algorithm.batch_size // _WINDOW, 1)
    return configuration.from_dict({"algorithm": {"sequence_length": _WINDOW, "batch_size": windows}}, config)


def remembering(shared: Base) -> RunConfig | None:
    """Make silent agents with a memory, where they see what others do."""
    if not shared.case.moves_tell:
        return None
    silent = sends(NONE, shared)
    changes = {"algorithm": {"network": {"recurrent": True, "parameters": shared.parameters}}}
    return in_windows(configuration.from_dict(changes, silent))


def uttering(shared: Base) -> RunConfig | None:
    """Make the settings of agents whose words are actions."""
    if shared.case.utterances is None:
        return None
    silent = sends(NONE, shared)
    return replace(silent, env=configuration.changed(silent.env, shared.case.utterances))


def learns_by(preset: str, shared: Base, times: int = 1) -> RunConfig:
    """Make another learner with the same network, which sends symbols; times: as many steps."""
    talking, other = shared.talking, configuration.on_task(presets.preset(preset), shared.talking.task)
    recurrent = talking.algorithm.network.recurrent
    network = replace(talking.algorithm.network, latent="none", parameters=shared.parameters, recurrent=recurrent)
    same = {name: getattr(talking.algorithm, name) for name in ("temperature", "temperature_end")}
    return replace(
        other,
        algorithm=replace(other.algorithm, network=network, **same),
        env=talking.env,
        seed=talking.seed,
        num_seeds=talking.num_seeds,
        training=replace(other.training, env_steps=talking.training.env_steps * times),
        evaluation=replace(talking.evaluation, interval=talking.evaluation.interval * times),
    )


_MESSAGES: Mapping[str, str] = MappingProxyType(
    {
        NONE: "nobody hears anybody",
        TOLD: "all that the speaker sees",
        SYMBOLS: "symbols, one-hot in play",
        "soft": "symbols, soft in play too",
        "dial": "bits, heard a step later (DIAL)",
        "commnet": "hidden vectors, averaged (CommNet)",
        "tarmac": "vectors that receivers ask for (TarMAC)",
        "ic3net": "hidden vectors behind a gate (IC3Net)",
    }
)


def kinds() -> dict[str, Kind]:
    """List the learners of the study, by name; kinds of messages that were added among them."""
    found = {name: Kind(says, partial(sends, name)) for name, says in _MESSAGES.items()}
    own = {name: Kind("messages of your own", partial(sends, name)) for name in COMMUNICATION if name not in found}
    return {
        NONE: found.pop(NONE),
        REMEMBERING: Kind("nobody hears anybody, and all remember", remembering),
        **found,
        **own,
        UTTERED: Kind("words among the actions, heard a step later", uttering),
        "mappo": Kind("MAPPO: symbols, one-hot in play", partial(learns_by, "graph-mappo")),
        "mappo-10x": Kind("the same with ten times the steps", partial(learns_by, "graph-mappo", times=10)),
        "qmix": Kind("QMIX: symbols, one-hot in play", partial(learns_by, "graph-qmix")),
    }
