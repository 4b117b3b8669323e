"""What is to be seen of `spread`: agents, and rings of the capture radius that light up when covered."""

import jax.numpy as jnp

from gacrl.envs.particles import pairwise_offsets
from gacrl.scene import Scene, compose, discs
from gacrl.tasks.spread.environment import CAPTURE_RADIUS, SpreadParams, SpreadState
from gacrl.tasks.spread.settings import SpreadSettings


def scene(settings: SpreadSettings, state: SpreadState, params: SpreadParams) -> Scene:
    """Return the moment of one environment. Lengths in arena units."""
    _, distance = pairwise_offsets(state.positions, state.landmarks)
    if params.agent_mask is not None:
        distance = jnp.where(params.agent_mask[:, None], distance, jnp.inf)
    covered = distance.min(0) < CAPTURE_RADIUS
    corner = jnp.full(2, params.arena_scale)
    return compose(
        agents=discs(state.positions, params.physics.agent_radius, params.agent_mask),
        marks=discs(state.landmarks, CAPTURE_RADIUS, params.landmark_mask, covered),
        ground=jnp.stack([-corner, corner]),
    )
