"""What is to be seen of the navigation tasks: coloured landmarks, and agents in the colour of the goal they seek."""

import jax.numpy as jnp

from gacrl.envs.particles import pairwise_offsets
from gacrl.scene import PLAIN, Scene, compose, discs
from gacrl.tasks.navigation.environment import NavigationParams, NavigationState
from gacrl.tasks.navigation.settings import RADII, NavigationSettings

SIZE = 0.08
"""Arena units: bodies do not touch, so that any radius would do."""


def scene(settings: NavigationSettings, state: NavigationState, params: NavigationParams) -> Scene:
    """Draw the moment of one environment. Lengths in arena units."""
    reached = float(RADII[0])
    _, distance = pairwise_offsets(state.positions, state.landmarks)
    seeks = jnp.asarray(settings.rules.seeks)
    sought = (state.goals[:, None] == jnp.arange(state.landmarks.shape[0])[None]) & seeks[:, None]
    corner = jnp.ones(2)
    return compose(
        agents=discs(state.positions, SIZE, colour=jnp.where(seeks, state.goals, PLAIN)),
        marks=discs(
            state.landmarks,
            reached,
            lit=((distance < reached) & sought).any(0),
            colour=jnp.arange(state.landmarks.shape[0]),
        ),
        ground=jnp.stack([-corner, corner]),
    )
