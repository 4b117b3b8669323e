"""Playing a policy in the real MPE2: its physics, its observations and its rewards, none of ours.

Only the measurements that MPE2 does not make (coverage, distances) are taken with our own rulers, on its
positions.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from gacrl.envs.environment import Environment
from gacrl.errors import UserError
from gacrl.evaluation.metrics import Tally, count_step_if, episode_metrics, no_steps, table_of
from gacrl.tasks.spread.environment import REPORTED_LOCAL_RATIO, Spread, SpreadState
from gacrl.tasks.spread.settings import METRICS
from gacrl.types import Memory, Policy, PRNGKey

_FIRST_SEED = 700_000
"""MPE2's seeds of the evaluation episodes: this one and those that follow."""


def evaluate(
    env: Environment, policy: Policy, initial_memory: Memory, key: PRNGKey, num_episodes: int
) -> dict[str, np.ndarray]:
    """The metrics [K] of K episodes of MPE2's simple_spread_v3 with the settings of `env`.

    The episodes run side by side, so that the policy is called once a step. Raises UserError for what MPE2
    does not have: another task, other than N landmarks, another arena, moving landmarks, resets on collision.
    """
    env = _require_possible(env)
    worlds = [_World(env, _FIRST_SEED + episode) for episode in range(num_episodes)]
    params = env.default_params()
    act = jax.jit(jax.vmap(policy))
    observe = jax.jit(jax.vmap(lambda state: env.observe(state, params)))
    measures = jax.eval_shape(lambda: env.measure(env.reset(key)[0], params))
    table = table_of(list(measures), METRICS)

    @jax.jit
    @jax.vmap
    def count(going: Array, tally: Tally, state: SpreadState, reward: Array) -> Tally:
        return count_step_if(going, tally, {**env.measure(state, params), "reward_raw": reward})

    tally = jax.vmap(lambda _: no_steps(table))(jnp.arange(num_episodes))
    memory = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (num_episodes, *leaf.shape)), initial_memory)
    going = np.ones(num_episodes, bool)
    for step_key in jax.random.split(key, env.max_cycles):
        state = _stacked(worlds)
        seen = observe(state)._replace(features=jnp.asarray(np.stack([world.features for world in worlds])))
        decision, memory = act(memory, seen, jax.random.split(step_key, num_episodes))
        actions = np.asarray(decision.action)
        rewards = [world.step(actions[i]) if going[i] else 0.0 for i, world in enumerate(worlds)]
        tally = count(going, tally, _stacked(worlds), np.array(rewards, np.float32))
        # A new array: JAX may still be reading the old one, which it need not have copied.
        going = going & np.array([not world.over for world in worlds])
    metrics = jax.vmap(lambda tally: episode_metrics(tally, table))(tally)
    return dict(zip(table.names, np.asarray(metrics).T, strict=True))


class _World:
    """One of MPE2's environments, seen as arrays."""

    def __init__(self, env: Spread, seed: int):
        from mpe2 import simple_spread_v3  # here: it starts pygame's fonts

        self._env: Any = simple_spread_v3.parallel_env(
            N=env.num_agents,
            local_ratio=REPORTED_LOCAL_RATIO,
            max_cycles=env.max_cycles,
            continuous_actions=env.continuous_actions,
            terminate_on_success=env.terminate_on_success,
            num_agent_neighbors=env.num_agent_neighbors,
            num_landmark_neighbors=env.num_landmark_neighbors,
        )
        self._take(self._env.reset(seed=seed)[0])
        self.world: Any = self._env.unwrapped.world
        self.over = False

    def _take(self, observations: dict[str, np.ndarray]) -> None:
        self.features = np.stack(list(observations.values()))

    def step(self, action: np.ndarray) -> float:
        """Act, and return the mean over agents of MPE2's reward at its default local ratio."""
        names = self._env.possible_agents
        observations, rewards, terminated, truncated, _ = self._env.step(dict(zip(names, action, strict=True)))
        self._take(observations)
        self.over = any(terminated.values()) or any(truncated.values())
        return float(np.mean(list(rewards.values())))

    def arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Positions and velocities of the agents, positions of the landmarks."""
        agents, landmarks = self.world.agents, self.world.landmarks
        return (
            np.array([agent.state.p_pos for agent in agents], np.float32),
            np.array([agent.state.p_vel for agent in agents], np.float32),
            np.array([landmark.state.p_pos for landmark in landmarks], np.float32),
        )


def _stacked(worlds: list[_World]) -> SpreadState:
    """Where all the worlds stand, [K, …]; their landmarks rest."""
    positions, velocities, landmarks = (
        jnp.asarray(np.stack(parts)) for parts in zip(*(world.arrays() for world in worlds), strict=True)
    )
    return SpreadState(
        positions, velocities, landmarks, jnp.zeros_like(landmarks), jnp.zeros(len(worlds), jnp.int32)
    )


def _require_possible(env: Environment) -> Spread:
    if not isinstance(env, Spread):
        raise UserError("MPE2 is asked for spread only: evaluate this run with --backend jax")
    lacks = {
        f"{env.landmarks} landmarks for {env.num_agents} agents": env.landmarks != env.num_agents,
        f"an arena scale of {env.arena_scale}": env.arena_scale != 1.0,
        "moving landmarks": env.landmark_speed != 0.0,
        "resets on collision": env.reset_on_collision != "off",
    }
    for thing, wanted in lacks.items():
        if wanted:
            raise UserError(f"MPE2 has no {thing}: evaluate this run with --backend jax")
    return env
