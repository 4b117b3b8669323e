"""Measuring and recording whatever `RUN` names: a run folder, one member of it, or a scripted policy."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal

import jax
import numpy as np

from gacrl import tasks
from gacrl.adapters import mpe2
from gacrl.config.algorithms import LearningConfig
from gacrl.config.run import EnvConfig
from gacrl.evaluation import episodes as recording
from gacrl.evaluation.evaluate import stream_key
from gacrl.evaluation.references import play_scripted
from gacrl.evaluation.summary import normalised, over_seeds
from gacrl.messages.bits import bits_used
from gacrl.play import TrainedRun, open_run
from gacrl.tasks.spread import scripted
from gacrl.tasks.spread.environment import Spread
from gacrl.types import Memory, Policy

Warn = Callable[[str], None]

_HEARD = 32
"""Episodes in which the symbols are counted."""


@dataclass(frozen=True)
class Changes:
    """What to alter about the task that a run was trained in; None leaves it."""

    horizon: int | None = None
    num_agents: int | None = None
    arena_scale: float | None = None

    def apply(self, env: EnvConfig) -> EnvConfig:
        """The altered task. Raises ConfigError for what cannot be."""
        changed = {"max_cycles": self.horizon, "num_agents": self.num_agents, "arena_scale": self.arena_scale}
        return replace(env, **{name: value for name, value in changed.items() if value is not None})


def score_run(
    run: str,
    episodes: int,
    changes: Changes | None = None,
    backend: Literal["jax", "mpe2"] = "jax",
    warn: Warn = lambda sentence: None,
) -> dict[str, Any]:
    """The metrics of a policy, greedy and sampled, with those of the scripted policies on the same starts.

    Returns {run, backend, episodes, horizon, num_agents, final: {greedy, sampled}, references} as in
    `summary.json`, and messages where agents send symbols. MPE2 draws its own starts: there, the scripted policies
    play those.
    """
    changes = changes or Changes()
    messages = None
    if run in scripted.PLAYABLE:
        env = tasks.make(changes.apply(EnvConfig()))
        references = _references(env, episodes, backend)
        metrics = references.get(run) or _scripted(run, env, episodes, backend)
        final = {"greedy": over_seeds({name: np.array([value]) for name, value in metrics.items()})}
    else:
        opened = open_run(run, changes.apply, warn)
        env = opened.env
        references = _references(env, episodes, backend)
        final = {
            kind: over_seeds(_trained(opened, kind == "sampled", episodes, backend))
            for kind in ("greedy", "sampled")
        }
        messages = _messages(opened)
    return {
        "run": run,
        "backend": backend,
        "episodes": episodes,
        "horizon": env.max_cycles,
        "num_agents": env.num_agents,
        "final": {kind: normalised(metrics, references) for kind, metrics in final.items()},
        "references": references,
        **({} if messages is None else {"messages": messages}),
    }


def _messages(opened: TrainedRun) -> dict[str, float] | None:
    """Bits that an agent of the first member sends in a step of greedy play, and how many a good code would need."""
    config = opened.config.algorithm
    if not isinstance(config, LearningConfig) or config.network.communication != "discrete":
        return None
    env, policy = opened.env, opened.policy(0, False)
    key = stream_key("report")
    heard = recording.record_many(env, policy, opened.trainer.memory, env.default_params(), key, _HEARD)
    conversations = env.num_symmetries if config.symmetric_play else 1
    sent = conversations * config.network.rounds * float(np.log2(config.network.vocabulary))
    used = bits_used(heard)
    return {"bits_sent": sent, "bits_used_last_round": 0.0 if used is None else used}


def record_run(
    run: str,
    episodes: int,
    changes: Changes | None = None,
    sampled: bool = False,
    warn: Warn = lambda sentence: None,
) -> list[recording.Episode]:
    """Episodes of a policy, to look at: the first of those that `score_run` measures."""
    changes = changes or Changes()
    policy: Policy
    memory: Memory
    if run in scripted.PLAYABLE:
        env = tasks.make(changes.apply(EnvConfig()))
        policy, memory = scripted.make(run, env)
    else:
        opened = open_run(run, changes.apply, warn)
        env, policy, memory = opened.env, opened.policy(0, sampled), opened.trainer.memory
    return recording.record_many(env, policy, memory, env.default_params(), stream_key("report"), episodes)


def _trained(opened: TrainedRun, explore: bool, episodes: int, backend: str) -> dict[str, np.ndarray]:
    """Each metric's mean over the episodes, one number per member [S]."""
    members = opened.config.num_seeds
    if backend == "jax":
        metrics = jax.device_get(opened.trainer.evaluate(opened.learners, explore, "report", episodes))
        return {name: values.mean(1)[:members] for name, values in metrics.items()}
    played = [
        mpe2.evaluate(opened.env, opened.policy(k, explore), opened.trainer.memory, stream_key("report"), episodes)
        for k in range(members)
    ]
    return {name: np.array([metrics[name].mean() for metrics in played]) for name in played[0]}


def _references(env: Spread, episodes: int, backend: str) -> dict[str, dict[str, float]]:
    return {name: _scripted(name, env, episodes, backend) for name in scripted.SCRIPTED}


def _scripted(name: str, env: Spread, episodes: int, backend: str) -> dict[str, float]:
    if backend == "jax":
        return play_scripted(name, env, episodes)
    policy, memory = scripted.make(name, env)
    metrics = mpe2.evaluate(env, policy, memory, stream_key("report"), episodes)
    return {metric: float(values.mean()) for metric, values in metrics.items()}
