"""No communication."""

from jaxtyping import Array, Float

from gacrl.config.algorithms import NetworkConfig
from gacrl.envs.environment import Environment
from gacrl.networks.communication.base import Communication, Neighbourhood, Spoken
from gacrl.types import PRNGKey


class Silence(Communication):
    """Nobody says anything."""

    def __init__(self, env: Environment, config: NetworkConfig, key: PRNGKey, gain: float | None = None):
        pass

    def speak(
        self,
        hidden: Float[Array, "N H"],
        near: Neighbourhood,
        key: PRNGKey | None,
        temperature: Float[Array, ""] | float,
        code: Float[Array, "N Z"] | None = None,
    ) -> Spoken:
        return Spoken(hidden, None)
