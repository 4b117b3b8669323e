"""How agents talk: a file for each kind, which `gacrl.config.kinds` names."""

import equinox as eqx
import jax

from gacrl.config.algorithms import NetworkConfig
from gacrl.config.kinds import COMMUNICATION, resolve
from gacrl.networks.communication.base import Communication, Neighbourhood, Spoken, neighbour_mean, received
from gacrl.types import PRNGKey

__all__ = [
    "Communication",
    "Neighbourhood",
    "Spoken",
    "hears_late",
    "kind_of",
    "make",
    "neighbour_mean",
    "received",
]


def kind_of(config: NetworkConfig) -> type[Communication]:
    """The class of messages that the configuration names."""
    return resolve(COMMUNICATION[config.communication])


def hears_late(config: NetworkConfig) -> bool:
    """Whether what is said at a step is heard at the next one."""
    kind = eqx.filter_eval_shape(make, config, jax.random.key(0))
    return bool(jax.tree.leaves(kind.empty_inbox(1)))


def make(config: NetworkConfig, key: PRNGKey, gain: float | None = None) -> Communication:
    """The messages that the configuration names."""
    return kind_of(config)(config, key, gain)  # pyright: ignore[reportCallIssue] every kind is made so
