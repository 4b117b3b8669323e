"""Playing a policy in the real MPE2: its physics, its observations and its rewards, none of ours.

Only the measurements that MPE2 does not make (coverage, distances) are taken with our own rulers, on its
positions.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from importlib import import_module
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from gacrl.envs.environment import Environment, EnvState
from gacrl.errors import UserError
from gacrl.evaluation.metrics import Tally, count_step_if, episode_metrics, no_steps, table_of
from gacrl.tasks.navigation import environment as navigation
from gacrl.tasks.navigation.environment import Navigation, NavigationState
from gacrl.tasks.navigation.settings import METRICS as NAVIGATION_METRICS
from gacrl.tasks.navigation.settings import ReferenceSettings, Rules, SpeakerListenerSettings
from gacrl.tasks.spread import environment as spread
from gacrl.tasks.spread.environment import REPORTED_LOCAL_RATIO, Spread, SpreadState
from gacrl.tasks.spread.settings import SCOUTS_METRICS
from gacrl.tasks.task import Metric
from gacrl.types import Memory, Policy, PRNGKey

_FIRST_SEED = 700_000
"""MPE2's seeds of the evaluation episodes: this one and those that follow."""


_WITH_GOALS: Mapping[Rules, str] = MappingProxyType(
    {
        SpeakerListenerSettings().rules: "simple_speaker_listener_v4",
        ReferenceSettings().rules: "simple_reference_v3",
    }
)
"""What MPE2 calls the navigation tasks that it has."""


class Scenario(NamedTuple):
    """How one of our tasks is played there."""

    make: Callable[[], Any]
    """MPE2's own environment, as PettingZoo's parallel ones."""
    state_of: Callable[[Sequence[Any]], EnvState]
    """Where K of its worlds stand, [K, …]."""
    pack: Callable[[Any], Array]
    """The exact state of one of them, as our task puts it into observations."""
    measure: Callable[[Any, Any], dict[str, Array]]
    """Our measurements of a state, with our task's params."""
    metrics: Mapping[str, Metric]


def evaluate(
    env: Environment, policy: Policy, initial_memory: Memory, key: PRNGKey, num_episodes: int
) -> dict[str, np.ndarray]:
    """Play K episodes of MPE2's task with the settings of `env` and return each metric [K].

    The episodes run side by side, so that the policy is called once a step. Messages pass by the policy's own network,
    and nothing is said in MPE2; where utterances are actions, they are MPE2's. Raises UserError for what MPE2 does not
    have: another task, other than N landmarks, another arena, moving landmarks, resets on collision.
    """
    played = scenario(env)
    worlds = [_World(env, played, _FIRST_SEED + episode) for episode in range(num_episodes)]
    params = env.default_params()
    act = jax.jit(jax.vmap(policy))
    state = played.state_of([world.world for world in worlds])

    @jax.jit
    @jax.vmap
    def show(state: EnvState, features: Array) -> Any:
        """Return what MPE2 shows, and for scripts the exact state."""
        return env.from_features(features)._replace(state=played.pack(state))

    measures = jax.eval_shape(lambda: played.measure(env.reset(key, params)[0], params))
    table = table_of(list(measures), played.metrics)

    @jax.jit
    @jax.vmap
    def count(going: Array, tally: Tally, state: EnvState, reward: Array) -> Tally:
        return count_step_if(going, tally, {**played.measure(state, params), "reward_raw": reward})

    tally = jax.vmap(lambda _: no_steps(table))(jnp.arange(num_episodes))
    memory = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (num_episodes, *leaf.shape)), initial_memory)
    going = np.ones(num_episodes, bool)
    for step_key in jax.random.split(key, env.max_cycles):
        seen = show(state, jnp.asarray(np.stack([world.features for world in worlds])))
        decision, memory = act(memory, seen, jax.random.split(step_key, num_episodes))
        actions = np.asarray(decision.action)
        rewards = [world.step(actions[i]) if going[i] else 0.0 for i, world in enumerate(worlds)]
        state = played.state_of([world.world for world in worlds])
        tally = count(going, tally, state, np.array(rewards, np.float32))
        # A new array: JAX may still be reading the old one, which it need not have copied.
        going = going & np.array([not world.over for world in worlds])
    metrics = jax.vmap(lambda tally: episode_metrics(tally, table))(tally)
    return dict(zip(table.names, np.asarray(metrics).T, strict=True))


class _World:
    """One of MPE2's environments, seen as arrays."""

    def __init__(self, env: Environment, played: Scenario, seed: int):
        self._ours, self._theirs = env, played.make()
        self._take(self._theirs.reset(seed=seed)[0])
        self.world: Any = self._theirs.unwrapped.world
        self.over = False

    def _take(self, observations: dict[str, np.ndarray]) -> None:
        self.features = self._ours.stack(list(observations.values()))

    def step(self, action: np.ndarray) -> float:
        """Act, and return the mean over agents of MPE2's reward at its default local ratio."""
        actions = dict(zip(self._theirs.possible_agents, self._ours.unstack(action), strict=True))
        observations, rewards, terminated, truncated, _ = self._theirs.step(actions)
        self._take(observations)
        self.over = any(terminated.values()) or any(truncated.values())
        return float(np.mean(list(rewards.values())))


def scenario(env: Environment) -> Scenario:
    """Find how this task is played in MPE2. Raises UserError where MPE2 does not have it."""
    if isinstance(env, Spread):
        _require_possible(env)
        return Scenario(partial(_spread, env), _spread_state, spread.pack_state, env.measure, SCOUTS_METRICS)
    if not isinstance(env, Navigation) or env.rules not in _WITH_GOALS:
        raise UserError(
            "MPE2 has spread (and so scouts), speaker_listener and reference: evaluate this run with --backend jax"
        )
    theirs = partial(_parallel, _WITH_GOALS[env.rules], max_cycles=env.max_cycles)
    return Scenario(theirs, navigation_state, navigation.pack_state, env.measure, NAVIGATION_METRICS)


def _parallel(name: str, **settings: Any) -> Any:
    return import_module(f"mpe2.{name}").parallel_env(**settings)  # here: it starts pygame's fonts


def _spread(env: Spread) -> Any:
    return _parallel(
        "simple_spread_v3",
        N=env.num_agents,
        local_ratio=REPORTED_LOCAL_RATIO,
        max_cycles=env.max_cycles,
        continuous_actions=env.continuous_actions,
        terminate_on_success=env.terminate_on_success,
        num_agent_neighbors=env.num_agent_neighbors,
        num_landmark_neighbors=env.num_landmark_neighbors,
    )


def _places(worlds: Sequence[Any]) -> tuple[Array, Array, Array]:
    """Positions and velocities of the agents [K N 2], positions of the landmarks [K L 2]."""

    def stacked(things: str, what: str) -> Array:
        rows = [[getattr(thing.state, what) for thing in getattr(world, things)] for world in worlds]
        return jnp.asarray(np.array(rows, np.float32))

    return stacked("agents", "p_pos"), stacked("agents", "p_vel"), stacked("landmarks", "p_pos")


def _spread_state(worlds: Sequence[Any]) -> SpreadState:
    """Where the worlds stand; their landmarks rest."""
    positions, velocities, landmarks = _places(worlds)
    return SpreadState(
        positions, velocities, landmarks, jnp.zeros_like(landmarks), jnp.zeros(len(worlds), jnp.int32)
    )


def navigation_state(worlds: Sequence[Any]) -> NavigationState:
    """Return where the worlds stand, and who seeks which landmark; the clock and what was said read as in the
    beginning.
    """
    positions, velocities, landmarks = _places(worlds)
    copies, num_agents = positions.shape[:2]
    order = jnp.arange(landmarks.shape[1], dtype=jnp.int32)
    return NavigationState(
        positions=positions,
        velocities=velocities,
        landmarks=landmarks,
        goals=jnp.asarray(np.array([_goals(world) for world in worlds], np.int32)),
        order=jnp.broadcast_to(order, (copies, num_agents, order.size)),
        words=jnp.full((copies, num_agents), -1, jnp.int32),
        clock=jnp.zeros(copies, jnp.int32),
    )


def _goals(world: Any) -> list[int]:
    """The landmark that each agent seeks: another one knows it; 0 of who seeks none."""
    known = {agent._goal_a.name: agent._goal_b for agent in world.agents if agent._goal_a is not None}
    return [world.landmarks.index(known[agent.name]) if agent.name in known else 0 for agent in world.agents]


def _require_possible(env: Spread) -> None:
    lacks = {
        f"{env.landmarks} landmarks for {env.num_agents} agents": env.landmarks != env.num_agents,
        f"an arena scale of {env.arena_scale}": env.arena_scale != 1.0,
        "moving landmarks": env.landmark_speed != 0.0,
        "resets on collision": env.reset_on_collision != "off",
    }
    for thing, wanted in lacks.items():
        if wanted:
            raise UserError(f"MPE2 has no {thing}: evaluate this run with --backend jax")
