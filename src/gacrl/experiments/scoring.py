"""Measuring and recording whatever `RUN` names: a run folder, one member of it, or a scripted policy."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, SupportsIndex

import jax
import numpy as np

from gacrl import tasks
from gacrl.adapters import mpe2
from gacrl.config.checks import require, whole
from gacrl.config.run import RunConfig
from gacrl.envs.environment import Environment, EnvParams
from gacrl.errors import UserError
from gacrl.evaluation import episodes as recording
from gacrl.evaluation import references
from gacrl.evaluation.evaluate import evaluate, stream_key
from gacrl.evaluation.summary import normalised, over_seeds
from gacrl.messages.bits import bits_sent, bits_used
from gacrl.networks.communication import kind_of
from gacrl.play import TrainedRun, open_run
from gacrl.tasks.task import Task
from gacrl.training import footprint
from gacrl.types import Intervention, Memory, Policy

Warn = Callable[[str], None]
Change = Callable[[Any], Any]
"""The settings of a task -> those to play in."""
Backend = Literal["jax", "mpe2"]

_HEARD = 32
"""Episodes in which the symbols are counted."""


def unchanged(settings: Any) -> Any:
    """Return the task as it was trained."""
    return settings


@dataclass(frozen=True)
class Played:
    """A task as it is played."""

    task: Task
    settings: Any

    @property
    def env(self) -> Environment:
        """Its environment."""
        return self.task.make(self.settings)


def score_run(
    run: str,
    episodes: SupportsIndex,
    change: Change = unchanged,
    backend: Backend = "jax",
    warn: Warn = lambda sentence: None,
    task: str = tasks.DEFAULT,
    intervention: Intervention | None = None,
    utter: bool = False,
) -> dict[str, Any]:
    """Measure a policy, greedy and sampled, beside the scripted policies on the same starts.

    task: in which a scripted policy plays. intervention: what happens to the policy's messages. utter: its symbols are
    sent as the task's own utterance actions, which are heard a step later. Returns {run, backend,
    episodes, horizon, num_agents, task, final: {greedy, sampled}, references} as in `summary.json`; intervention, in
    words, where there is one; and messages where agents send symbols. MPE2 draws its own starts: there, the scripted
    policies play those. Raises UserError.
    """
    messages, done, episodes = None, None, whole(episodes, "episodes", 1)
    scripted = _scripted_task(run, task, change)
    if scripted is not None:
        _require_words(run, intervention)
        require(not utter, f"{run} says nothing that could be uttered: leave --utter out")
        played = scripted
        _require_room(played, episodes)
        beside = _references(played, episodes, backend)
        metrics = beside.get(run) or _play_scripted(run, played, episodes, backend)
        final = {"greedy": over_seeds({name: np.array([value]) for name, value in metrics.items()})}
    else:
        opened = open_run(run, change, warn, intervention)
        require(
            not utter or intervention is None, "what is uttered arrives: leave --utter or the intervention out"
        )
        if utter:
            _require_utterable(opened.task, opened.config)
        done = _in_backend(backend, intervention, opened.trainer.intervention, warn)
        played = Played(opened.task, opened.config.env)
        _require_room(played, episodes, opened.trainer.memory)
        beside = _references(played, episodes, backend)
        final = {
            kind: over_seeds(_trained(opened, kind == "sampled", episodes, backend, utter))
            for kind in ("greedy", "sampled")
        }
        messages = _messages(opened)
    facts = played.task.facts(played.settings, list(final["greedy"]))
    return {
        "run": run,
        "backend": backend,
        "episodes": episodes,
        "horizon": int(played.env.max_cycles),
        "num_agents": int(played.env.num_agents),
        "task": facts,
        "final": {kind: normalised(metrics, beside, facts) for kind, metrics in final.items()},
        "references": beside,
        **({} if done is None else {"intervention": done.told}),
        **({"intervention": "symbols are uttered, and heard a step later"} if utter else {}),
        **({} if messages is None else {"messages": messages}),
    }


def play(
    run: str,
    episodes: SupportsIndex,
    change: Change = unchanged,
    intervention: Intervention | None = None,
    sampled: bool = False,
    task: str | None = None,
) -> dict[str, np.ndarray]:
    """Play the fixed episodes of the report and return each metric [S, K] of S seeds; scripted policies have one.

    Raises UserError.
    """
    episodes = whole(episodes, "episodes", 1)
    scripted = _scripted_task(run, tasks.DEFAULT if task is None else task, change)
    if scripted is not None:
        _require_words(run, intervention)
        _require_room(scripted, episodes)
        metrics = references.scripted_episodes(run, scripted.task.name, scripted.settings, episodes)
        return {name: np.asarray(values)[None] for name, values in metrics.items()}
    opened = open_run(run, change, intervention=intervention)
    _require_room(Played(opened.task, opened.config.env), episodes, opened.trainer.memory)
    metrics = jax.device_get(opened.trainer.evaluate(opened.learners, sampled, "report", episodes))
    return {name: values[: opened.config.num_seeds] for name, values in metrics.items()}


def _require_words(scripted: str, intervention: Intervention | None) -> None:
    require(
        intervention is None,
        f"{scripted} says nothing: there are no messages to intervene in; leave the intervention out",
    )


def _in_backend(
    backend: Backend, asked: Intervention | None, trained: Intervention | None, warn: Warn
) -> Intervention | None:
    """What happens to messages there; the real MPE2 knows our agents' messages, and nothing that is done to them."""
    if backend == "jax":
        return trained if asked is None else asked
    require(asked is None, "in the real MPE2 every message arrives: take the backend jax, or no intervention")
    if trained is not None:
        warn(f"in training {trained.told}; in the real MPE2 every message arrives")
    return None


def _require_room(played: Played, episodes: int, memory: Memory = ()) -> None:
    """Raises UserError for more, or larger, episodes than this machine has the memory to play side by side."""
    env = played.env
    params = played.task.numbers(played.settings, env)
    footprint.require_room_to_play(footprint.playing_bytes(env, params, memory, episodes))


def _scripted_task(run: str, task: str, change: Change) -> Played | None:
    """The task that a scripted policy of this name plays; None for a run."""
    found = tasks.find(task)
    if run not in references.playable(found):
        return None
    return Played(found, change(tasks.default_settings(task)))


def _require_utterable(task: Task, config: RunConfig) -> None:
    """Raise UserError where the task has no utterances, or what agents say is no word in every step."""
    if task.uttered is None:
        raise UserError(f"{task.name} has no utterances among its actions: leave --utter out")
    network = getattr(config.algorithm, "network", None)
    if network is not None and (network.gate or not kind_of(network).sends_symbols):
        says = "may say nothing" if network.gate else f"send {network.communication}"
        raise UserError(f"only symbols in every step can be uttered, and these agents {says}: leave --utter out")


def _messages(opened: TrainedRun) -> dict[str, float] | None:
    """Bits that an agent of the first member sends in a step of greedy play, and how many a good code would need."""
    config, env = opened.config.algorithm, opened.env
    network = getattr(config, "network", None)
    if network is None or not kind_of(network).sends_symbols:
        return None
    heard = _record(
        opened.policy(0, False),
        opened.trainer.memory,
        env,
        opened.trainer.evaluation_params,
        _HEARD,
        opened.trainer.intervention,
        pictures=False,
    )
    conversations = env.num_symmetries if config.symmetric_play else 1
    sent = conversations * (bits_sent(env, network) or 0.0)
    used = bits_used(heard)
    return {"bits_sent": sent, "bits_used_last_round": 0.0 if used is None else used}


class Recorded(NamedTuple):
    """Episodes of a policy to look at, the task that they are of, and what happened to messages in them."""

    episodes: list[recording.Episode]
    task: Task
    intervention: Intervention | None = None


def record_run(
    run: str,
    episodes: SupportsIndex,
    change: Change = unchanged,
    sampled: bool = False,
    warn: Warn = lambda sentence: None,
    task: str = tasks.DEFAULT,
    intervention: Intervention | None = None,
) -> Recorded:
    """Record episodes of a policy, to look at: the first of those that `score_run` measures."""
    episodes, played = whole(episodes, "episodes", 1), _scripted_task(run, task, change)
    if played is not None:
        _require_words(run, intervention)
        actor = references.actor(played.task, run, played.env)
        policy, memory, env = actor.policy, actor.initial_memory, played.env
        params = played.task.numbers(played.settings, env)
    else:
        opened = open_run(run, change, warn, intervention)
        played = Played(opened.task, opened.config.env)
        intervention = opened.trainer.intervention
        policy, memory, env = opened.policy(0, sampled), opened.trainer.memory, opened.env
        params = opened.trainer.evaluation_params
    look = references.look_of(played.task, played.settings)
    _require_room(played, episodes, memory)
    footprint.require_room_to_play(footprint.recording_bytes(env, params, episodes, look))
    recorded = _record(policy, memory, env, params, episodes, intervention, look)
    return Recorded(recorded, played.task, intervention)


def _record(
    policy: Policy,
    memory: Memory,
    env: Environment,
    params: EnvParams,
    episodes: int,
    intervention: Intervention | None = None,
    look: recording.Look | None = None,
    pictures: bool = True,
) -> list[recording.Episode]:
    key = stream_key("report")
    return recording.record_many(env, policy, memory, params, key, episodes, intervention, look, pictures)


def _trained(
    opened: TrainedRun, explore: bool, episodes: int, backend: Backend, utter: bool
) -> dict[str, np.ndarray]:
    """Each metric's mean over the episodes, one number per member [S]."""
    members = opened.config.num_seeds
    if backend == "jax" and not utter:
        metrics = jax.device_get(opened.trainer.evaluate(opened.learners, explore, "report", episodes))
        return {name: values.mean(1)[:members] for name, values in metrics.items()}
    played = [_member(opened, k, explore, episodes, backend, utter) for k in range(members)]
    return {name: np.array([metrics[name].mean() for metrics in played]) for name in played[0]}


def _member(
    opened: TrainedRun, member: int, explore: bool, episodes: int, backend: Backend, utter: bool
) -> Mapping[str, Any]:
    """Each metric of one seed's episodes [K]."""
    env, policy, memory, key = (
        opened.env,
        opened.policy(member, explore),
        opened.trainer.memory,
        stream_key("report"),
    )
    if utter and opened.task.uttered is not None:
        env, policy = opened.task.uttered(env, policy)
    if backend == "mpe2":
        return mpe2.evaluate(env, policy, memory, key, episodes)
    params, metrics = opened.trainer.evaluation_params, opened.task.metrics
    return jax.jit(lambda: evaluate(env, policy, memory, params, key, episodes, metrics=metrics))()


def _references(played: Played, episodes: int, backend: Backend) -> dict[str, dict[str, float]]:
    return {name: _play_scripted(name, played, episodes, backend) for name in references.shown(played.task)}


def _play_scripted(name: str, played: Played, episodes: int, backend: Backend) -> dict[str, float]:
    if backend == "jax":
        return references.play_scripted(name, played.task.name, played.settings, episodes)
    policy, memory = references.actor(played.task, name, played.env)
    metrics = mpe2.evaluate(played.env, policy, memory, stream_key("report"), episodes)
    return {metric: float(values.mean()) for metric, values in metrics.items()}
