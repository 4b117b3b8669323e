"""`scouts`: `spread` in which some agents see no landmarks.

Who sees must tell them where to go. They move, are seen, see each other and cover landmarks as all others do.
"""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from gacrl.envs.particles import along
from gacrl.scene import PLAIN, Scene
from gacrl.tasks.spread.environment import Spread, SpreadParams, SpreadState
from gacrl.tasks.spread.scene import scene as spread_scene
from gacrl.tasks.spread.settings import ScoutsSettings
from gacrl.types import Observation


@dataclass(frozen=True)
class Scouts(ScoutsSettings, Spread):
    """The task of these settings."""

    def observe(self, state: SpreadState, params: SpreadParams) -> Observation:
        """Show what `spread` shows, and 0 to the blind in the place of landmarks, as where there are none."""
        return self._seen(super().observe(state, params))

    def from_features(self, features: Float[Array, "N O"]) -> Observation:
        """Make the observation around the features of `spread`, as MPE2 hands them out to everyone."""
        return self._seen(super().from_features(features))

    def _seen(self, observation: Observation) -> Observation:
        features = observation.features
        return observation._replace(features=jnp.where(along(jnp.asarray(self._sees()), features), features, 0.0))

    def _sees(self) -> Bool[np.ndarray, "N O"]:
        """Which numbers of what `spread` shows each agent sees."""
        number = np.arange(self.observation_size)
        landmark = (number >= 4) & (number < 4 + 2 * self.seen_landmarks)
        return ~(np.array(self.blind)[:, None] & landmark)

    def measure(self, state: SpreadState, params: SpreadParams) -> dict[str, Float[Array, "*e"]]:
        """Measure what `spread` does, and whether every landmark has an agent within 0.2."""
        measured = super().measure(state, params)
        return {**measured, "success_0.2": (measured["coverage_0.2"] == 1.0) * 1.0}


def make(settings: ScoutsSettings) -> Scouts:
    """Make the environment of these settings."""
    return Scouts(**vars(settings))


def scene(settings: ScoutsSettings, state: SpreadState, params: SpreadParams) -> Scene:
    """Draw the moment of one environment: the blind have a broad rim of a colour."""
    shown = spread_scene(settings, state, params)
    colour = jnp.where(jnp.asarray(settings.blind), 0, PLAIN)
    return shown._replace(agents=shown.agents._replace(colour=colour))
