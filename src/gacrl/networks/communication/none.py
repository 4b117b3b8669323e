"""No communication."""

from jaxtyping import Array, Float

from gacrl.config.algorithms import NetworkConfig
from gacrl.networks.communication.base import Communication, Neighbourhood, Spoken
from gacrl.types import Channel, PRNGKey


class Silence(Communication):
    """Nobody says anything."""

    def __init__(self, config: NetworkConfig, key: PRNGKey, gain: float | None = None):
        pass

    def speak(
        self,
        hidden: Float[Array, "N H"],
        near: Neighbourhood,
        channel: Channel,
        key: PRNGKey | None,
        temperature: Float[Array, ""] | float,
        code: Float[Array, "N Z"] | None = None,
    ) -> Spoken:
        return Spoken(hidden, None)
