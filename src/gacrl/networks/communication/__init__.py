"""How agents talk: a file for each kind, which `gacrl.config.kinds` names."""

from gacrl.config.algorithms import NetworkConfig
from gacrl.config.kinds import COMMUNICATION, resolve
from gacrl.envs.environment import Environment
from gacrl.networks.communication.base import Communication, Neighbourhood, Spoken, neighbour_mean, received
from gacrl.types import PRNGKey

__all__ = [
    "Communication",
    "Neighbourhood",
    "Spoken",
    "kind_of",
    "make",
    "neighbour_mean",
    "received",
]


def kind_of(config: NetworkConfig) -> type[Communication]:
    """Return the class of messages that the configuration names."""
    return resolve(COMMUNICATION[config.communication])


def make(env: Environment, config: NetworkConfig, key: PRNGKey, gain: float | None = None) -> Communication:
    """Make the messages that the configuration names."""
    return kind_of(config)(env, config, key, gain)  # pyright: ignore[reportCallIssue] every kind is made so
