"""The navigation tasks in pure JAX: MPE's particle world without contact, in which agents seek goals that others know.

`speaker_listener` and `reference` are step for step MPE2's simple_speaker_listener_v4 and simple_reference_v3: places,
velocities, rewards and what is seen; `colours` follows the same rules.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from gacrl.envs.environment import Environment, TimeStep, observe
from gacrl.envs.particles import DIRECTIONS, Physics, action_forces, integrate
from gacrl.envs.symmetry import NUM_SYMMETRIES, turn_action, turn_vectors
from gacrl.tasks.navigation.settings import RADII, NavigationSettings, Rules
from gacrl.types import Entities, Observation, PRNGKey

MOVES = len(DIRECTIONS)


class NavigationState(NamedTuple):
    """N agents and L landmarks; lengths and velocities in MPE2's units."""

    positions: Float[Array, "N 2"]
    velocities: Float[Array, "N 2"]
    landmarks: Float[Array, "L 2"]
    goals: Int[Array, " N"]
    """The landmark that each agent seeks."""
    order: Int[Array, "N L"]
    """Which landmark each agent sees first, second, …"""
    words: Int[Array, " N"]
    """What each agent said at the step before, counted from 0; −1 for nothing."""
    clock: Int[Array, ""]
    """Steps taken in this episode."""


class NavigationParams(NamedTuple):
    """The numbers of the task."""

    physics: Physics
    local_ratio: Float[Array, ""] | float
    goal_bonus: Float[Array, ""] | float


@dataclass(frozen=True)
class Navigation(Environment):
    """A task of these rules. Actions are `say · 5 + move`, where an agent has both."""

    rules: Rules
    max_cycles: int = 25
    utters: bool = False
    """Utterances are among the actions, and are seen a step later; nothing else is heard."""
    identity: bool = True
    local_ratio: float = 0.0
    goal_bonus: float = 1.0

    @property
    def num_agents(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.rules.num_agents

    @property
    def num_actions(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        return MOVES * (self.rules.words if self.utters else 1)

    @property
    def shortest_truncated(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.max_cycles

    @property
    def num_symmetries(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        return NUM_SYMMETRIES

    @property
    def vectors(self) -> int:
        """Numbers at the front of what an agent sees that are vectors: velocity, landmarks, other agents."""
        return 2 + 2 * self.rules.landmarks + 2 * self._others

    @property
    def observation_size(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The vectors, the goal that it knows, what the others said, and which agent it is."""
        heard = self.rules.words * (self.num_agents - 1)
        return self.vectors + self.rules.landmarks + heard + self.num_agents * self.identity

    @property
    def _others(self) -> int:
        return self.num_agents - 1 if self.rules.bodies else 0

    def default_params(self) -> NavigationParams:
        """Return the numbers of the settings, as data to every compiled program."""
        params = NavigationParams(Physics(), self.local_ratio, self.goal_bonus)
        return jax.tree.map(lambda number: jnp.asarray(number, float), params)

    def reset(self, key: PRNGKey, params: NavigationParams | None = None) -> tuple[NavigationState, Observation]:
        """Place agents and landmarks uniformly, agents at rest; goals are independent and uniform."""
        num_agents, landmarks = self.num_agents, self.rules.landmarks
        place_key, goal_key, order_key = jax.random.split(key, 3)
        places = jax.random.uniform(place_key, (num_agents + landmarks, 2), jnp.float32, -1.0, 1.0)
        places = places.astype(float)  # the same starts in double precision
        order = jnp.broadcast_to(jnp.arange(landmarks), (num_agents, landmarks))
        if not self.rules.named:
            order = jax.vmap(jax.random.permutation)(jax.random.split(order_key, num_agents), order)
        state = NavigationState(
            positions=places[:num_agents],
            velocities=jnp.zeros((num_agents, 2), places.dtype),
            landmarks=places[num_agents:],
            goals=jax.random.randint(goal_key, (num_agents,), 0, landmarks, jnp.int32),
            order=order,
            words=jnp.full(num_agents, -1, jnp.int32),
            clock=jnp.zeros((), jnp.int32),
        )
        return state, self.observe(state)

    def step(
        self, state: NavigationState, action: Array, key: PRNGKey, params: NavigationParams | None = None
    ) -> tuple[NavigationState, TimeStep]:
        """Move, say, and earn by the places after the move."""
        params = self.default_params() if params is None else params
        forces = action_forces(action % MOVES, params.physics, False)
        positions, velocities = integrate(state.positions, state.velocities, forces, params.physics)
        moves = jnp.asarray(self.rules.moves)[:, None]
        state = state._replace(
            positions=jnp.where(moves, positions, state.positions),
            velocities=jnp.where(moves, velocities, state.velocities),
            words=(action // MOVES).astype(jnp.int32) if self.utters else state.words,
            clock=state.clock + 1,
        )
        reward, info = self._score(state, params)
        reward = reward + params.goal_bonus * info[f"reached_{RADII[0]}"]
        truncated = state.clock >= self.max_cycles
        return state, TimeStep(self.observe(state), reward, jnp.zeros_like(truncated), truncated, info)

    def measure(self, state: NavigationState, params: NavigationParams) -> dict[str, Float[Array, ""]]:
        """Measure what `step` does, from where everything stands after it."""
        return self._score(state, params)[1]

    def _score(
        self, state: NavigationState, params: NavigationParams
    ) -> tuple[Float[Array, " N"], dict[str, Float[Array, ""]]]:
        """Return MPE2's reward of each agent, and the measurements."""
        distance, seeks = self._distance(state), jnp.asarray(self.rules.seeks)
        lost = jnp.square(distance) if self.rules.squared else distance
        reward = self._reward(lost, params.local_ratio)
        info = {"reward_raw": reward.mean(), "distance_goal": _mean(distance, seeks)}
        for radius in RADII:
            there = distance < float(radius)
            info |= {f"reached_{radius}": _mean(there, seeks), f"success_{radius}": (there | ~seeks).all() * 1.0}
        return reward, info

    def _reward(self, lost: Float[Array, " N"], local_ratio: Float[Array, ""] | float) -> Float[Array, " N"]:
        """MPE2's: an agent's own part is how far the one whose goal it knows is from it; all share the mean."""
        mean = _mean(lost, jnp.asarray(self.rules.seeks))
        known = lost[np.array(self.rules.knows)]
        return -(local_ratio * known + (1 - local_ratio) * mean)

    def _distance(self, state: NavigationState) -> Float[Array, " N"]:
        """Each agent's to its goal."""
        return jnp.sqrt(jnp.square(state.positions - state.landmarks[state.goals]).sum(-1))

    def observe(self, state: NavigationState) -> Observation:
        """Show each agent what it may see, in MPE2's order, and the exact state to critics and scripts."""
        rules, num_agents = self.rules, self.num_agents
        moves = jnp.asarray(rules.moves)[:, None]
        offsets = state.landmarks[None] - state.positions[:, None]  # [N L 2]
        seen = jnp.take_along_axis(offsets, state.order[..., None], axis=1).reshape(num_agents, -1)
        parts = [jnp.where(moves, jnp.concatenate([state.velocities, seen], axis=1), 0.0)]
        if rules.bodies:
            parts.append(_others(state.positions[None] - state.positions[:, None]).reshape(num_agents, -1))
        parts += [self._known_goal(state), self._heard(state)]
        if self.identity:
            parts.append(jnp.eye(num_agents))
        return self.from_features(jnp.concatenate(parts, axis=1))._replace(state=pack_state(state))

    def seen_in(self, state: NavigationState, params: NavigationParams | None = None) -> Observation:
        """Return what is seen in a state that a hand has changed."""
        return self.observe(state)

    def from_features(self, features: Float[Array, "N O"]) -> Observation:
        """Make the observation around what `observe` or `stack` laid out; the exact state is not known."""
        available, graph = jnp.asarray(self._available()), jnp.asarray(self._graph())
        return observe(features, available=available, adjacency=graph)

    def _known_goal(self, state: NavigationState) -> Float[Array, "N L"]:
        """The goal that each agent knows of another one, as MPE2's colours; 0 where it knows none."""
        knows, (low, high) = np.array(self.rules.knows), self.rules.colours
        shown = state.order == state.goals[knows][:, None]
        return jnp.where((knows >= 0)[:, None], jnp.where(shown, high, low), 0.0)

    def _heard(self, state: NavigationState) -> Float[Array, "N C"]:
        """What the others said at the step before, side by side; 0 for those that do not speak, or cannot be heard."""
        num_agents, words = self.num_agents, self.rules.words
        if not words:
            return jnp.zeros((num_agents, 0))
        said = jax.nn.one_hot(state.words, words) * np.array(self.rules.speaks)[:, None]
        heard = jnp.asarray(self._hearing())[:, :, None] * said[None]
        return _others(heard).reshape(num_agents, -1)

    def _hearing(self) -> Bool[np.ndarray, "N N"]:
        hears = np.zeros((self.num_agents, self.num_agents), bool)
        for listener, speakers in enumerate(self.rules.hears):
            hears[listener, list(speakers)] = True
        return hears

    def _graph(self) -> Bool[np.ndarray, "N N"]:
        """Along which messages arrive in the same step: none where utterances are actions."""
        return self._hearing() & (not self.utters)

    def _available(self) -> Bool[np.ndarray, "N A"]:
        rules = self.rules
        action, moves = np.arange(self.num_actions), np.array(rules.moves)[:, None]
        speaks = np.array(rules.speaks or (False,) * self.num_agents)[:, None]
        return (moves | (action % MOVES == 0)) & (speaks | (action // MOVES == 0))

    def stack(self, rows: Sequence[Any]) -> Float[np.ndarray, "N O"]:
        """Lay out MPE2's observations as `observe` does; identities, and 0 for what an agent does not see, are added.

        Raises ConfigError where they do not fit.
        """
        places, layout = self._seen_in_mpe2(), self.observation_size - self.num_agents * self.identity
        if [np.size(row) for row in rows] != [len(seen) for seen in places]:
            return super().stack(rows)
        features = np.zeros((self.num_agents, self.observation_size), np.float32)
        for agent, row in enumerate(rows):
            features[agent, places[agent]] = row
        if not self.utters:
            features[:, self.vectors + self.rules.landmarks : layout] = 0.0
        if self.identity:
            features[:, layout:] = np.eye(self.num_agents)
        return features

    def _seen_in_mpe2(self) -> list[Int[np.ndarray, " _"]]:
        """Where in the features of each agent the numbers stand that MPE2 shows it."""
        rules, heard = self.rules, self.vectors + self.rules.landmarks
        vectors, goal = np.arange(self.vectors), np.arange(self.vectors, heard)
        words = np.arange(heard, heard + rules.words * (self.num_agents - 1))
        nothing = np.arange(0)
        return [
            np.concatenate(
                [
                    vectors if rules.moves[agent] else nothing,
                    goal if rules.knows[agent] >= 0 else nothing,
                    words if rules.hears[agent] else nothing,
                ]
            )
            for agent in range(self.num_agents)
        ]

    def unstack(self, actions: Array | np.ndarray) -> list[int]:
        """Return MPE2's actions: of who does not move what it says, of who does not speak how it moves."""
        rules = self.rules
        if not self.utters and rules.words:
            actions = np.asarray(actions) % MOVES
        return [
            int(action) if rules.moves[agent] else int(action) // MOVES for agent, action in enumerate(actions)
        ]

    def entities(self, observation: Observation) -> Entities:
        """Take what is seen apart: landmarks with their colours, or with the mark of the goal that is known."""
        rules, features = self.rules, self.telling(observation)
        num_agents, seen = self.num_agents, 2 + 2 * rules.landmarks
        heard = self.vectors + rules.landmarks
        goal = features[:, self.vectors : heard]
        rest = features[:, heard if self.utters else heard + rules.words * (num_agents - 1) :]
        landmarks = features[:, 2:seen].reshape(num_agents, rules.landmarks, 2)
        agents = features[:, seen : self.vectors].reshape(num_agents, -1, 2)
        moves = jnp.asarray(rules.moves)[:, None]
        if rules.named:
            colours = jnp.broadcast_to(jnp.eye(rules.landmarks), (num_agents, *(rules.landmarks,) * 2))
            own = [features[:, :2], goal, rest]
        else:
            colours, own = goal[..., None], [features[:, :2], rest]
        return Entities(
            own=jnp.concatenate(own, axis=1),
            landmarks=landmarks,
            agents=agents,
            landmark_mask=jnp.broadcast_to(moves, landmarks.shape[:2]),
            agent_mask=jnp.ones(agents.shape[:2], bool),
            landmark_features=colours,
            agent_features=self._names() if rules.bodies and self.identity else None,
        )

    def _names(self) -> Float[Array, "N N-1 N"]:
        """Which agent each other one is: told by its place in the row, as one's own identity says whose row it is."""
        return _others(jnp.broadcast_to(jnp.eye(self.num_agents), (self.num_agents,) * 3))

    def telling(self, observation: Observation) -> Float[Array, "N O"]:
        """Return what is seen, the goal that is known as one-hot: MPE2's colours are pale."""
        features, (low, high) = observation.features, self.rules.colours
        if (low, high) == (0.0, 1.0):
            return features
        begin, end = self.vectors, self.vectors + self.rules.landmarks
        goal = features[:, begin:end]
        return features.at[:, begin:end].set(jnp.where(goal > 0, (goal - low) / (high - low), 0.0))

    def turn(self, observation: Observation, symmetry: Int[Array, ""]) -> Observation:
        """Turn the vectors; colours, words and identities stay."""
        features, state, placed = observation.features, observation.state, self._placed
        assert state is not None
        vectors, others = jnp.split(features, [self.vectors], axis=-1)
        places, goals = jnp.split(state, [placed], axis=-1)
        return observation._replace(
            features=jnp.concatenate([turn_vectors(vectors, symmetry), others], axis=-1),
            state=jnp.concatenate([turn_vectors(places, symmetry), goals], axis=-1),
        )

    @property
    def _placed(self) -> int:
        return 4 * self.num_agents + 2 * self.rules.landmarks

    def turn_action(self, action: Array, symmetry: Int[Array, ""]) -> Array:
        """Turn the move, and say the same."""
        return action // MOVES * MOVES + turn_action(action % MOVES, symmetry, False)


def pack_state(state: NavigationState) -> Float[Array, " S"]:
    """Write places, velocities, landmarks and goals (one-hot) as one vector: S = 4 N + 2 L + N L."""
    goals = jax.nn.one_hot(state.goals, state.landmarks.shape[0])
    parts = (state.positions, state.velocities, state.landmarks, goals)
    return jnp.concatenate([part.reshape(-1) for part in parts])


def unpack_state(
    packed: Float[Array, " S"], num_agents: int, landmarks: int
) -> tuple[Float[Array, "N 2"], Float[Array, "N 2"], Float[Array, "L 2"], Int[Array, " N"]]:
    """Read places, velocities, landmarks and goals back."""
    ends = np.cumsum([2 * num_agents, 2 * num_agents, 2 * landmarks])
    positions, velocities, places, goals = jnp.split(packed, ends)
    goals = goals.reshape(num_agents, landmarks).argmax(-1)
    return positions.reshape(-1, 2), velocities.reshape(-1, 2), places.reshape(-1, 2), goals


def make(settings: NavigationSettings) -> Navigation:
    """Make the environment of these settings."""
    return Navigation(
        rules=settings.rules,
        max_cycles=settings.max_cycles,
        utters=settings.talk == "actions",
        identity=settings.identity,
        local_ratio=getattr(settings, "local_ratio", 0.0),
        goal_bonus=settings.goal_bonus,
    )


def _others(pairs: Float[Array, "N N F"]) -> Float[Array, "N N-1 F"]:
    """Row i without its entry i."""
    size = pairs.shape[0]
    others = np.array([[j for j in range(size) if j != i] for i in range(size)], int)
    return pairs[np.arange(size)[:, None], others]


def _mean(values: Array, mask: Bool[Array, " N"]) -> Float[Array, ""]:
    return jnp.where(mask, values * 1.0, 0.0).sum() / mask.sum()
