"""`spread`: simple_spread_v3 of MPE2 1.1.1, step for step, for any number of agents and landmarks.

N agents must stand on L landmarks without touching each other. Beyond MPE2: L ≠ N, an arena of any size,
landmarks that move, padded agents, and the readings of the paper's "resets if agents collide".

As in `envs.particles`, arrays may have axes of copies at their end; `Spread.step_many` steps many copies so.
"""

from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, Shaped, UInt32

from gacrl.envs.environment import Environment, TimeStep, typed_keys
from gacrl.envs.particles import (
    DIRECTIONS,
    Physics,
    action_forces,
    along,
    between_agents,
    contact_forces,
    integrate,
    pairwise_offsets,
)
from gacrl.envs.symmetry import NUM_SYMMETRIES, turn_action, turn_vectors
from gacrl.tasks.spread.potential import assignment_potential, potential_difference
from gacrl.tasks.spread.settings import SpreadSettings
from gacrl.tasks.spread.shaping import paper_shaped_reward
from gacrl.types import Entities, Observation, PRNGKey

CAPTURE_RADIUS = 0.1
"""MPE2's radius of a covered landmark."""
COVERAGE_RADII = (0.1, 0.2, 0.5)
NEAR_DISTANCE = 0.2
"""The paper counts agents with a neighbour this close; their discs touch at 0.3."""
REPORTED_LOCAL_RATIO = 0.5
"""`reward_raw` is always taken at MPE2's default, whatever the learner is trained on."""


class SpreadParams(NamedTuple):
    """Everything about the task that is a number: change it between steps, nothing recompiles."""

    physics: Physics
    local_ratio: Float[Array, ""] | float
    """Weight of an agent's own collisions; the shared distance has 1 − local_ratio."""
    collision_penalty: Float[Array, ""] | float
    """0 is the first stage of MPE2's `curriculum`."""
    coverage_threshold: Float[Array, ""] | float
    """θ of equation (1), of the paper's exploration and of the metric `coverage_theta`."""
    coverage_bonus: Float[Array, ""] | float
    """Of the reward `coverage`: what a step with every landmark covered adds."""
    potential_discount: Float[Array, ""] | float | None
    """γ of the reward `potential`; None: 1."""
    arena_scale: Float[Array, ""] | float
    """Agents and landmarks start uniformly in [−arena_scale, arena_scale]²."""
    landmark_speed: Float[Array, ""] | float
    """Speed of the landmarks, as a share of an agent's top speed."""
    reset_distance: Float[Array, ""] | float
    """Agents this close count as collided for `reset_on_collision`."""
    agent_mask: Bool[Array, " N"] | None = None
    """False for padding; None: all agents are real, and nothing is spent on masks."""
    landmark_mask: Bool[Array, " L"] | None = None


def params_of(settings: SpreadSettings, gamma: float = 1.0, padded: bool = False) -> SpreadParams:
    """Return the numbers of the task as arrays, so that they are data to every compiled program.

    gamma: the learner's discount, for the reward `potential`. padded: with masks, in which all are there.
    """
    params = SpreadParams(
        physics=Physics(),
        local_ratio=settings.local_ratio,
        collision_penalty=1.0,
        coverage_threshold=settings.coverage_threshold,
        coverage_bonus=settings.coverage_bonus,
        potential_discount=gamma if settings.reward == "potential" else None,
        arena_scale=settings.arena_scale,
        landmark_speed=settings.landmark_speed,
        reset_distance=settings.reset_distance,
    )
    params = jax.tree.map(lambda number: jnp.asarray(number, float), params)
    if not padded:
        return params
    agents, landmarks = np.ones(settings.num_agents, bool), np.ones(settings.landmarks, bool)
    return params._replace(agent_mask=jnp.asarray(agents), landmark_mask=jnp.asarray(landmarks))


class SpreadState(NamedTuple):
    """N agents and L landmarks; lengths and velocities in MPE2's units."""

    positions: Float[Array, "N 2"]
    velocities: Float[Array, "N 2"]
    landmarks: Float[Array, "L 2"]
    landmark_velocities: Float[Array, "L 2"]
    clock: Int[Array, ""]
    """Steps taken in this episode."""


@dataclass(frozen=True)
class Spread(SpreadSettings, Environment):
    """The task of these settings. Its numbers are in `SpreadParams`; those of the settings are where they start."""

    observes_state: ClassVar[bool] = True
    pushes: ClassVar[bool] = True

    @property
    def num_actions(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        return len(DIRECTIONS)

    @property
    def seen_landmarks(self) -> int:
        return self.landmarks if self.num_landmark_neighbors is None else self.num_landmark_neighbors

    @property
    def seen_agents(self) -> int:
        return self.num_agents - 1 if self.num_agent_neighbors is None else self.num_agent_neighbors

    @property
    def observation_size(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Velocity, position, landmarks, other agents, their silent channel of two numbers each."""
        return 4 + 2 * self.seen_landmarks + 4 * self.seen_agents

    @property
    def shortest_truncated(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        return 1 if self.reset_on_collision == "truncate" else self.max_cycles

    def default_params(self) -> SpreadParams:
        """Return the numbers of the settings; γ is 1, and nobody is absent."""
        return params_of(self)

    def reset(self, key: PRNGKey, params: SpreadParams | None = None) -> tuple[SpreadState, Observation]:
        """Place agents and landmarks uniform in the arena, agents at rest."""
        params = self.default_params() if params is None else params
        state = self._place(typed_keys(key), params)
        return state, self.observe(state, params)

    def step_many(
        self,
        state: SpreadState,
        action: Array,
        keys: Key[Array, " E"] | UInt32[Array, "E _"],
        params: SpreadParams | None = None,
    ) -> tuple[SpreadState, TimeStep]:
        """Return what `step` is for each of E copies [E, …], to rounding; several times as fast as mapping it."""
        last_state, last_action = _copies_last((state, action))
        return _copies_first(self.step(last_state, last_action, keys, params))

    def observe_many(self, state: SpreadState, params: SpreadParams | None = None) -> Observation:
        """Return what `observe` is for each of E copies [E, …]."""
        params = self.default_params() if params is None else params
        return _copies_first(self.observe(_copies_last(state), params))

    def step(
        self,
        state: SpreadState,
        action: Array,
        key: Key[Array, "*e"] | UInt32[Array, "*e _"],
        params: SpreadParams | None = None,
    ) -> tuple[SpreadState, TimeStep]:
        """Move the world by one step. action: [N] indices, or [N, 5] in [0, 1] with continuous actions."""
        params = self.default_params() if params is None else params
        before = state
        state = self._move(state, action, params)
        info = self.measure(state, params)
        if self.reward == "paper":
            reward = jnp.broadcast_to(info["reward_shaped"], (self.num_agents, *state.clock.shape))
        else:
            reward = self.rewards(state, params)
        if self.reward == "coverage":
            reward += params.coverage_bonus * info[f"coverage_{CAPTURE_RADIUS}"][None]
        truncated = state.clock >= self.max_cycles
        terminated = jnp.zeros_like(truncated)
        if self.terminate_on_success:
            # MPE2 looks at the time limit first: success at the last step is a truncation there.
            terminated = (info[f"success_{CAPTURE_RADIUS}"] == 1.0) & ~truncated
        if self.reset_on_collision != "off":
            distance = _nearest_agent(state.positions, params.agent_mask)
            collided = (distance < params.reset_distance).any(0)
            if self.reset_on_collision == "truncate":
                truncated |= collided
            else:
                fresh = self._place(typed_keys(key), params)._replace(clock=state.clock)
                state = jax.tree.map(
                    lambda new, old: jnp.where(jnp.broadcast_to(collided, old.shape), new, old), fresh, state
                )
        if self.reward == "potential":
            discount = 1.0 if params.potential_discount is None else params.potential_discount
            potentials = self._potential(before, params), self._potential(state, params)
            reward += potential_difference(*potentials, discount, terminated)[None]
        reward = _masked(reward, params.agent_mask)
        return state, TimeStep(self.observe(state, params), reward, terminated, truncated, info)

    def _potential(self, state: SpreadState, params: SpreadParams) -> Float[Array, "*e"]:
        def one(positions: Float[Array, "N 2 *e"], landmarks: Float[Array, "L 2 *e"]) -> Float[Array, "*e"]:
            if positions.ndim > 2:
                return jax.vmap(one, in_axes=-1, out_axes=-1)(positions, landmarks)
            return assignment_potential(positions, landmarks, params.agent_mask, params.landmark_mask)

        return one(state.positions, state.landmarks)

    def rewards(self, state: SpreadState, params: SpreadParams) -> Float[Array, "N *e"]:
        """Return MPE2's reward of each agent: its own collisions, and everyone's distance to the landmarks."""
        _, to_landmarks = pairwise_offsets(state.positions, state.landmarks)
        shared = -_masked(_over_agents(to_landmarks, params), params.landmark_mask).sum(0)
        own = -params.collision_penalty * _touching(state.positions, params).sum(1)
        return own * params.local_ratio + shared[None] * (1 - params.local_ratio)

    def observe(self, state: SpreadState, params: SpreadParams) -> Observation:
        """Return what each agent sees, in MPE2's order, and the exact state for central critics and oracles.

        Whatever stands in the place of padding is 0.
        """
        offsets, distance = pairwise_offsets(state.positions, state.landmarks)
        there = None if params.landmark_mask is None else params.landmark_mask[None, :]
        landmarks = _nearest(offsets, distance, there, self.num_landmark_neighbors)

        offsets, distance, pairs = between_agents(state.positions, params.agent_mask)
        there = None if params.agent_mask is None else _without_self(pairs)
        agents = _nearest(_without_self(offsets), _without_self(distance), there, self.num_agent_neighbors)

        copies = state.clock.shape
        flat = (self.num_agents, -1, *copies)
        silence = jnp.zeros((self.num_agents, 2 * self.seen_agents, *copies), state.positions.dtype)
        features = jnp.concatenate(
            [state.velocities, state.positions, landmarks.reshape(flat), agents.reshape(flat), silence],
            axis=1,
        )
        agent_mask, landmark_mask = params.agent_mask, params.landmark_mask
        state = SpreadState(
            positions=_masked(state.positions, agent_mask),
            velocities=_masked(state.velocities, agent_mask),
            landmarks=_masked(state.landmarks, landmark_mask),
            landmark_velocities=_masked(state.landmark_velocities, landmark_mask),
            clock=state.clock,
        )
        return Observation(
            features=_masked(features, agent_mask),
            positions=state.positions,
            agent_mask=_everywhere(agent_mask, (self.num_agents, *copies)),
            landmark_mask=_everywhere(landmark_mask, (self.landmarks, *copies)),
            action_mask=jnp.ones((self.num_agents, self.num_actions, *copies), bool),
            state=pack_state(state),
        )

    def from_features(self, features: Float[Array, "N O"]) -> Observation:
        """Return the observation around bare feature vectors, as other simulators hand them out.

        Positions stand in the features; the exact state is not known.
        """
        return Observation(
            features=features,
            positions=features[:, 2:4],
            agent_mask=jnp.ones(self.num_agents, bool),
            landmark_mask=jnp.ones(self.landmarks, bool),
            action_mask=jnp.ones((self.num_agents, self.num_actions), bool),
        )

    def entities(self, observation: Observation) -> Entities:
        """Return what the features say, thing by thing, without where the origin lies: an agent's own is its velocity.

        MPE2 pads with zeros: what is at distance 0 is not there.
        """
        features, landmarks_end = observation.features, 4 + 2 * self.seen_landmarks
        agents_end = landmarks_end + 2 * self.seen_agents
        own = features[:, :2]
        landmarks = features[:, 4:landmarks_end].reshape(self.num_agents, -1, 2)
        agents = features[:, landmarks_end:agents_end].reshape(self.num_agents, -1, 2)
        there = (jnp.square(offsets).sum(-1) > 0 for offsets in (landmarks, agents))
        return Entities(own, landmarks, agents, *there)

    def sight(self, observation: Observation) -> Float[Array, "N N S"]:
        """Return the offset to each agent in sight; 0 of the others."""
        positions, count = observation.positions, self.num_agent_neighbors
        assert positions is not None
        if count == 0:
            return jnp.zeros((self.num_agents, self.num_agents, 0))
        offsets = positions[None, :, :] - positions[:, None, :]
        if count is None or count >= self.num_agents - 1:
            return offsets
        there = observation.agent_mask[None, :] & ~jnp.eye(self.num_agents, dtype=bool)
        distance = jnp.where(there, jnp.square(offsets).sum(-1), jnp.inf)
        farthest = -jax.lax.top_k(-distance, count)[0][:, -1:]
        return jnp.where((distance <= farthest)[..., None] & there[..., None], offsets, 0.0)

    @property
    def num_symmetries(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        return NUM_SYMMETRIES

    def turn(self, observation: Observation, symmetry: Int[Array, ""]) -> Observation:
        """Return the observation of the turned world: all that it holds are vectors in the plane."""
        return observation._replace(
            features=turn_vectors(observation.features, symmetry),
            positions=None if observation.positions is None else turn_vectors(observation.positions, symmetry),
            state=None if observation.state is None else turn_vectors(observation.state, symmetry),
        )

    def turn_action(self, action: Array, symmetry: Int[Array, ""]) -> Array:
        """Return the action that does in the turned world what this one does here."""
        return turn_action(action, symmetry, self.continuous_actions)

    def measure(self, state: SpreadState, params: SpreadParams) -> dict[str, Float[Array, "*e"]]:
        """Return the measurements of one step; `gacrl.evaluation.metrics` turns them into an episode's.

        Distances in arena units; coverages are fractions of the landmarks that have an agent within the
        radius in the name; `collisions` counts touching pairs, `near_agents` is the fraction of agents with
        a neighbour within `NEAR_DISTANCE`.
        """
        _, to_landmarks = pairwise_offsets(state.positions, state.landmarks)
        landmark_distance = _over_agents(to_landmarks, params)
        hidden = None if params.landmark_mask is None else params.landmark_mask[None, :]
        own_distance = jnp.min(_masked(to_landmarks, hidden, jnp.inf), axis=1)
        neighbour_distance = _nearest_agent(state.positions, params.agent_mask)
        touching = _touching(state.positions, params).sum((0, 1))

        agents, landmarks = params.agent_mask, params.landmark_mask
        shared = -_masked(landmark_distance, landmarks).sum(0)
        own = -touching / _count(agents, self.num_agents)
        learner_raw = params.collision_penalty * own * params.local_ratio + shared * (1 - params.local_ratio)

        coverage = {f"coverage_{r}": _mean(landmark_distance < r, landmarks) for r in COVERAGE_RADII}
        return {
            "reward_raw": own * REPORTED_LOCAL_RATIO + shared * (1 - REPORTED_LOCAL_RATIO),
            "reward_shaped": paper_shaped_reward(
                learner_raw,
                own_distance,
                neighbour_distance,
                params.coverage_threshold,
                self.collision_distance,
                self.collision_term,
                agents,
            ),
            **coverage,
            "coverage_theta": _mean(landmark_distance < params.coverage_threshold, landmarks),
            f"success_{CAPTURE_RADIUS}": _all(landmark_distance < CAPTURE_RADIUS, landmarks),
            "distance_agent_landmark": _mean(own_distance, agents),
            "distance_landmark_agent": _mean(landmark_distance, landmarks),
            "distance_agent_agent": _mean_pair_distance(state.positions, agents),
            "collisions": touching / 2,
            "near_agents": _mean(neighbour_distance < NEAR_DISTANCE, agents),
        }

    def _place(self, key: Key[Array, "*e"], params: SpreadParams) -> SpreadState:
        entities, copies = self.num_agents + self.landmarks, key.shape

        def draw(key: Key[Array, "*e"]) -> Float[Array, "K *e"]:
            if key.ndim:
                return jax.vmap(draw, out_axes=-1)(key)
            size = 2 * entities + self.landmarks
            places = jax.random.uniform(key, (size,), dtype=jnp.float32, minval=-1.0, maxval=1.0)
            return places.astype(float)  # the same starts in double precision

        draws = draw(key)
        places = draws[: 2 * entities].reshape(entities, 2, *copies) * params.arena_scale
        heading = jnp.pi * draws[2 * entities :]
        speed = params.landmark_speed * params.physics.top_speed
        return SpreadState(
            positions=places[: self.num_agents],
            velocities=jnp.zeros((self.num_agents, 2, *copies), places.dtype),
            landmarks=places[self.num_agents :],
            landmark_velocities=speed * jnp.stack([jnp.cos(heading), jnp.sin(heading)], axis=1),
            clock=jnp.zeros(copies, jnp.int32),
        )

    def _move(self, state: SpreadState, action: Array, params: SpreadParams) -> SpreadState:
        forces = action_forces(action, params.physics, self.continuous_actions)
        forces += contact_forces(state.positions, params.agent_mask, params.physics)
        positions, velocities = integrate(state.positions, state.velocities, forces, params.physics)
        landmarks, landmark_velocities = reflect(
            state.landmarks + state.landmark_velocities * params.physics.time_step,
            state.landmark_velocities,
            params.arena_scale,
        )
        return SpreadState(positions, velocities, landmarks, landmark_velocities, state.clock + 1)


def reflect(
    positions: Float[Array, "L 2 *e"], velocities: Float[Array, "L 2 *e"], limit: Float[Array, ""] | float
) -> tuple[Float[Array, "L 2 *e"], Float[Array, "L 2 *e"]]:
    """Mirror what has left [−limit, limit]² back inside, once, and turn its velocity around."""
    bounced = jnp.where(positions > limit, 2 * limit - positions, positions)
    bounced = jnp.where(positions < -limit, -2 * limit - positions, bounced)
    return bounced, jnp.where(jnp.abs(positions) > limit, -velocities, velocities)


def pack_state(state: SpreadState) -> Float[Array, "S *e"]:
    """Return the global state as one vector: S = 4 N + 4 L."""
    return jnp.concatenate([part.reshape(-1, *state.clock.shape) for part in state[:4]])


def unpack_state(packed: Float[Array, " S"], num_agents: int) -> SpreadState:
    """Return the inverse of `pack_state`; the clock is not in it and reads 0."""
    agents, landmarks = packed[: 4 * num_agents], packed[4 * num_agents :]
    positions, velocities = agents.reshape(2, num_agents, 2)
    places, headings = landmarks.reshape(2, -1, 2)
    return SpreadState(positions, velocities, places, headings, jnp.zeros((), jnp.int32))


def _copies_last(tree: Any) -> Any:
    return jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, -1), tree)


def _copies_first(tree: Any) -> Any:
    return jax.tree.map(lambda leaf: jnp.moveaxis(leaf, -1, 0), tree)


def _without_self(pairs: Shaped[Array, "N N *r"]) -> Shaped[Array, "N N-1 *r"]:
    """Row i without its entry i. (By slices: in one long row, the diagonal is every N + 1st entry.)"""
    size, rest = pairs.shape[0], pairs.shape[2:]
    after_first = pairs.reshape(size * size, *rest)[1:]
    rows = after_first.reshape(size - 1, size + 1, *rest)[:, :-1]
    return rows.reshape(size, size - 1, *rest)


def _nearest(
    offsets: Float[Array, "N M 2 *e"],
    distance: Float[Array, "N M *e"],
    there: Bool[Array, "#N M *#e"] | None,
    count: int | None,
) -> Float[Array, "N K 2 *e"]:
    """The offsets of the `count` nearest, nearest first and zero-padded; of all in order where it is None."""
    if there is not None:
        there = jnp.broadcast_to(along(there, distance), distance.shape)
        offsets = jnp.where(there[:, :, None], offsets, 0.0)
        distance = jnp.where(there, distance, jnp.inf)
    if count is None:
        return offsets
    count_there = min(count, distance.shape[1])
    _, nearest = jax.lax.top_k(-jnp.moveaxis(distance, 1, -1), count_there)  # far from a full sort
    chosen = jnp.take_along_axis(offsets, jnp.moveaxis(nearest, -1, 1)[:, :, None], axis=1)
    return jnp.pad(chosen, ((0, 0), (0, count - chosen.shape[1]), *[(0, 0)] * (chosen.ndim - 2)))


def _over_agents(to_landmarks: Float[Array, "N L *e"], params: SpreadParams) -> Float[Array, "L *e"]:
    """Each landmark's distance to its nearest agent."""
    return jnp.min(_masked(to_landmarks, params.agent_mask, jnp.inf), axis=0)


def _touching(positions: Float[Array, "N 2 *e"], params: SpreadParams) -> Bool[Array, "N N *e"]:
    _, distance, pairs = between_agents(positions, params.agent_mask)
    return (distance < 2 * params.physics.agent_radius) & pairs


def _nearest_agent(positions: Float[Array, "N 2 *e"], mask: Bool[Array, " N"] | None) -> Float[Array, "N *e"]:
    """Each agent's distance to its nearest neighbour; infinity where it has none."""
    _, distance, pairs = between_agents(positions, mask)
    return jnp.min(jnp.where(pairs, distance, jnp.inf), axis=1)


def _mean_pair_distance(positions: Float[Array, "N 2 *e"], mask: Bool[Array, " N"] | None) -> Float[Array, "*e"]:
    """Mean distance between two agents; 0 for one agent alone."""
    _, distance, pairs = between_agents(positions, mask)
    return jnp.where(pairs, distance, 0.0).sum((0, 1)) / jnp.maximum(pairs.sum(), 1)


def _masked(values: Array, mask: Array | None, fill: float = 0.0) -> Array:
    """Values [M, …] where the mask [M] is true."""
    return values if mask is None else jnp.where(along(mask, values), values, fill)


def _everywhere(mask: Bool[Array, " M"] | None, shape: tuple[int, ...]) -> Bool[Array, "M *e"]:
    """The mask for each copy; None is all true."""
    return (
        jnp.ones(shape, bool)
        if mask is None
        else jnp.broadcast_to(mask.reshape(-1, *[1] * (len(shape) - 1)), shape)
    )


def _count(mask: Bool[Array, " M"] | None, size: int) -> Array | int:
    return size if mask is None else mask.sum()


def _mean(values: Array, mask: Bool[Array, " M"] | None) -> Float[Array, "*e"]:
    """Mean over the real entries."""
    return _masked(values * 1.0, mask).sum(0) / _count(mask, values.shape[0])


def _all(values: Bool[Array, "M *e"], mask: Bool[Array, " M"] | None) -> Float[Array, "*e"]:
    real = values if mask is None else values | ~along(mask, values)
    return real.all(0) * 1.0
