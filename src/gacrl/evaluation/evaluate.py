"""Playing a policy on fixed episodes and measuring them."""

import zlib
from collections.abc import Mapping
from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from gacrl import rollout
from gacrl.envs.environment import Environment, EnvParams
from gacrl.envs.hosted import Hosted
from gacrl.evaluation import on_host
from gacrl.evaluation.metrics import Tally, count_step_if, episode_metrics, no_steps, table_of
from gacrl.tasks.task import RETURN, Metric
from gacrl.types import Intervention, Memory, Policy, PRNGKey

Stream = Literal["training", "monitor", "gate", "report", "view"]
"""Random streams that never meet: training, evaluations along the way, success gates, the report, the live page."""

_EVALUATION_SEED = 20_260_101
"""The starts of evaluation episodes are the same for every run, seed and scripted policy."""


def stream_key(stream: Stream, seed: int = _EVALUATION_SEED) -> PRNGKey:
    """Return the root key of a stream of random numbers; the name is folded in, so streams never coincide."""
    return jax.random.fold_in(jax.random.key(seed), zlib.crc32(stream.encode()))


def evaluate(
    env: Environment,
    policy: Policy,
    initial_memory: Memory,
    params: EnvParams,
    key: PRNGKey,
    num_episodes: int,
    intervention: Intervention | None = None,
    metrics: Mapping[str, Metric] = RETURN,
) -> dict[str, Float[Array, " K"]]:
    """Measure K episodes, each up to its end or the environment's time limit.

    intervention: what happens to the agents' messages. metrics: those of the task; a measure without one gets its
    mean. The key fixes the starts and the policy's draws:
    the same key gives every policy the same starts. An environment that lives in Python is played by the host.
    """
    if isinstance(env, Hosted):
        playing = on_host.actors(env, policy, initial_memory, intervention)
        return jax.tree.map(jnp.asarray, on_host.evaluate(env, playing, key, num_episodes, metrics))
    start_key, act_key = jax.random.split(key)
    carry = rollout.start(env, params, initial_memory, start_key, num_episodes, intervention, policy)
    first_step = jax.eval_shape(
        lambda: rollout.step(env, policy, initial_memory, params, carry, act_key, intervention)[1]
    )
    table = table_of(list(first_step.info), metrics)
    tally = jax.vmap(lambda _: no_steps(table))(jnp.arange(num_episodes))

    def one_step(loop: tuple[rollout.Carry, Array, Tally], key: PRNGKey):
        carry, going, tally = loop
        carry, transition = rollout.step(env, policy, initial_memory, params, carry, key, intervention)
        tally = jax.vmap(count_step_if)(going, tally, transition.info)
        return (carry, going & ~carry.first, tally), None

    (_, _, tally), _ = jax.lax.scan(
        one_step,
        (carry, jnp.ones(num_episodes, bool), tally),
        jax.random.split(act_key, env.max_cycles),
    )
    values = jax.vmap(lambda tally: episode_metrics(tally, table))(tally)
    return dict(zip(table.names, values.T, strict=True))
