"""Training an algorithm on every probe at once, in one compiled program."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gacrl.algorithms import build as algorithms
from gacrl.config.algorithms import AlgorithmConfig
from gacrl.config.run import TrainingConfig
from gacrl.envs.probes import PROBES, Probe, ProbeParams
from gacrl.evaluation.evaluate import evaluate, stream_key
from gacrl.training.curriculum import constant
from gacrl.training.devices import KNOWN_XLA
from gacrl.training.trainer import Trainer
from gacrl.types import Learner


class ProbeResult(NamedTuple):
    """What an algorithm learned on the probes, by their names."""

    returns: dict[str, float]
    """Greedy return of each probe."""
    values: dict[str, tuple[float, float]]
    """The value that the first agent's decision holds at an episode's first observation, where the sign is −1 and
    where it is 1; NaN for algorithms whose decisions hold no value."""


def probe_algorithm(
    config: AlgorithmConfig,
    num_updates: int,
    num_envs: int = 1,
    num_steps: int = 1,
    *,
    seed: int = 0,
    probes: tuple[str, ...] = PROBES,
) -> ProbeResult:
    """Train on these probes, mapped over them, and say what was learned."""
    env = Probe()
    training = TrainingConfig(num_updates * num_envs * num_steps, num_envs, num_steps)
    algorithm = algorithms.make(config, env, training)
    trainer = Trainer(algorithm, env, constant(), num_envs, num_steps)

    def learn(probe: jax.Array) -> dict[str, jax.Array]:
        params = ProbeParams(probe)
        state = trainer.init_member(stream_key("training", seed), algorithm.hyper, params)
        state, _ = trainer.chunk_of_one(state, jnp.asarray(num_updates))
        policy = algorithm.policy(state.learner, False)
        metrics = evaluate(env, policy, trainer.memory, params, stream_key("monitor"), 32)
        return {
            "return": metrics["return_agent_mean"].mean(),
            "value": _values(trainer, env, state.learner, params),
        }

    learned = jax.device_get(_compiled(jax.vmap(learn))(jnp.array([PROBES.index(name) for name in probes])))
    return ProbeResult(
        {name: float(learned["return"][k]) for k, name in enumerate(probes)},
        {name: (float(learned["value"][k][0]), float(learned["value"][k][1])) for k, name in enumerate(probes)},
    )


def _compiled(program: Callable[[jax.Array], dict[str, jax.Array]]) -> Any:
    """Optimised no more than a program deserves that runs for seconds: compiling it then takes a third of the time.

    On versions that are known to have these options; others compile as they like.
    """
    known = KNOWN_XLA and jax.default_backend() == "cpu"
    options = {
        "xla_backend_optimization_level": 0,
        "xla_llvm_disable_expensive_passes": True,
        "xla_cpu_use_fusion_emitters": False,
    }
    return jax.jit(program, compiler_options=options if known else None)


def _values(trainer: Trainer, env: Probe, learner: Learner, params: ProbeParams) -> jax.Array:
    """The value of the first observation at each sign."""
    policy = trainer.algorithm.policy(learner, False)

    def value(sign: jax.Array) -> jax.Array:
        state, _ = env.reset(jax.random.key(0), params)
        seen = env.observe(state._replace(sign=sign), params)
        decision, _ = policy(trainer.memory, seen, jax.random.key(0))
        extras = decision.extras
        known = extras["value"] if isinstance(extras, dict) and "value" in extras else jnp.asarray(np.nan)
        return jnp.ravel(known)[0]

    return jax.vmap(value)(jnp.array([-1.0, 1.0]))
