"""The compiled part of training: one chunk of updates, and one evaluation, of one seed or several.

A trainer knows no particular algorithm; what it trains is an `Algorithm` record.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jax.sharding import Mesh
from jaxtyping import Array, Bool, Float, Int, Key

from gacrl import rollout
from gacrl.algorithms.contract import Algorithm, Hyper
from gacrl.algorithms.shared import share_out
from gacrl.envs.environment import Environment, EnvParams
from gacrl.evaluation.episodes import Look, Played, play
from gacrl.evaluation.evaluate import Stream, evaluate, stream_key
from gacrl.evaluation.metrics import (
    EpisodeSummary,
    Tally,
    count_step,
    episode_metrics,
    measures_of,
    no_episodes,
    no_steps,
    sum_up,
    table_of,
)
from gacrl.tasks.task import RETURN, Metric
from gacrl.training.curriculum import Curriculum, CurriculumState
from gacrl.training.devices import compiler_options, map_seeds, mesh_for, shard_seeds, stack_seeds
from gacrl.types import Intervention, Learner, Metrics, PRNGKey, Transition


class TrainState(NamedTuple):
    """The whole of a seed's training between two updates: what a checkpoint holds."""

    learner: Learner
    carry: rollout.Carry
    env_params: EnvParams
    curriculum: CurriculumState
    tally: Tally
    """The episodes under way, [E]."""
    episodes: Int[Array, ""]
    """Episodes finished."""
    key: PRNGKey
    updates: Int[Array, ""]


class Fault(NamedTuple):
    """The first observation or reward of a chunk that is not a finite number."""

    step: Int[Array, ""]
    """Environment steps that its copy had taken since training began, this one included; 0 for none."""
    agent: Int[Array, ""]
    reward: Bool[Array, ""]
    """It is a reward, and not an observation."""


def find_fault(steps: Transition, updates: Int[Array, ""]) -> Fault:
    """Return the first fault of a rollout [T, E, …], after so many updates."""
    seen = ~jnp.isfinite(steps.observation.features).all(-1)
    earned = ~jnp.isfinite(steps.reward)
    bad = jnp.stack([seen, earned], -1)  # [T E N 2]
    first = jnp.argmax(bad.any((1, 2, 3)))
    _, agent, kind = jnp.unravel_index(jnp.argmax(bad[first]), bad.shape[1:])
    step = updates * bad.shape[0] + first + 1
    return Fault(jnp.where(bad.any(), step, 0), agent, kind == 1)


def earlier(first: Fault | None, fault: Fault | None) -> Fault | None:
    """Return the first of two faults, one after the other; None where nobody looks."""
    if first is None or fault is None:
        return None
    known = first.step > 0
    return jax.tree.map(lambda old, new: jnp.where(known, old, new), first, fault)


Update: TypeAlias = tuple[TrainState, EpisodeSummary, Metrics, Fault | None]
"""The state after an update, the episodes that ended in it, what it measured, and its first fault."""


class ChunkReport(NamedTuple):
    """What a chunk of updates showed."""

    episodes: EpisodeSummary
    metrics: Metrics
    """The update's own metrics (losses, exploration), their mean over the chunk."""
    env_params: EnvParams
    """The task's parameters in the chunk's last update."""
    fault: Fault | None = None
    """The first number of the task that was not finite; None where nobody looks."""


class Running(NamedTuple):
    """A chunk so far."""

    state: TrainState
    seen: EpisodeSummary
    totals: Metrics
    """The sums of the updates' metrics."""
    used: EnvParams
    """The task's parameters in the last update."""
    fault: Fault | None


Chunk: TypeAlias = Callable[[TrainState, Any], tuple[TrainState, ChunkReport]]
"""(state, number of updates) -> the state after them, and what they showed; over stacked seeds."""


class AbstractTrainer(ABC):
    """Functions over stacked seeds (the seeds' axis in front of every leaf): all but how experience is gathered."""

    def __init__(
        self,
        algorithm: Algorithm,
        env: Environment,
        curriculum: Curriculum,
        num_envs: int,
        num_steps: int,
        num_seeds: int = 1,
        evaluation_env: Environment | None = None,
        mesh: Mesh | None = None,
        for_speed: bool = True,
        params: EnvParams = None,
        evaluation_params: EnvParams = None,
        metrics: Mapping[str, Metric] = RETURN,
        watched: bool = False,
        intervention: Intervention | None = None,
        look: Look | None = None,
    ):
        """params: the task's numbers, in training and as evaluated; None: those of the environments. metrics: the
        task's. watched: look for observations and rewards that are not finite. intervention: what happens to messages,
        in training and evaluations alike. look: what there is to see of a state as evaluated."""
        self.algorithm = algorithm
        self.env = env
        self.curriculum = curriculum
        self.num_envs = num_envs
        self.num_steps = num_steps
        self.num_seeds = num_seeds
        self.for_speed = for_speed
        """How training is compiled: see `devices.compiler_options`."""
        self.evaluation_env = env if evaluation_env is None else evaluation_env
        self.params = env.default_params() if params is None else params
        self.evaluation_params = (
            self.evaluation_env.default_params() if evaluation_params is None else evaluation_params
        )
        self.metrics, self.watched, self.intervention, self.look = metrics, watched, intervention, look
        self.mesh = mesh_for(num_seeds) if mesh is None else mesh
        """The devices that the seeds, and perhaps their environments, are spread over."""
        self.memory = algorithm.initial_memory(env.num_agents)
        self.table = table_of(measures_of(env, self.params), metrics)
        """What the vectors of a chunk's episode summary hold."""
        self.chunk = self.make_chunk()

    def init(self, seeds: tuple[int, ...]) -> TrainState:
        """Make fresh training states of these seeds, stacked."""
        return shard_seeds(self.init_stacked(seeds), self.mesh)

    def init_stacked(self, seeds: tuple[int, ...]) -> TrainState:
        """Return the same, not yet laid out on the devices."""
        keys = [stream_key("training", seed) for seed in seeds]
        return stack_seeds([self.init_member(key, self.algorithm.hyper) for key in keys])

    def init_member(self, key: Key[Array, ""], hyper: Hyper, params: EnvParams | None = None) -> TrainState:
        """Return a fresh training state of one seed, with these hyperparameters in this task."""
        return self._init(key, hyper, self.params if params is None else params)

    def lower_init(self, seed: int) -> Any:
        """Lower what makes a fresh training state, to be compiled ahead."""
        return AbstractTrainer._init.lower(self, stream_key("training", seed), self.algorithm.hyper, self.params)

    @partial(jax.jit, static_argnums=0)
    def _init(self, key: Key[Array, ""], hyper: Hyper, params: EnvParams) -> TrainState:
        learner_key, start_key, key = jax.random.split(key, 3)
        curriculum, params = self.curriculum.init(params)
        learner = self.algorithm.init(learner_key, hyper)
        policy = self.algorithm.policy(learner, True)
        carry = rollout.start(self.env, params, self.memory, start_key, self.num_envs, self.intervention, policy)
        tally = jax.vmap(lambda _: no_steps(self.table))(jnp.arange(self.num_envs))
        return TrainState(
            learner=learner,
            carry=carry,
            env_params=params,
            curriculum=curriculum,
            tally=tally,
            episodes=jnp.zeros((), jnp.int32),
            key=key,
            updates=jnp.zeros((), jnp.int32),
        )

    @abstractmethod
    def make_chunk(self) -> Any:
        """Return the chunk of updates that `chunk` is: it may keep what it is given."""

    @abstractmethod
    def compiled(self, state: TrainState, num_updates: int) -> Chunk:
        """Compile what a chunk needs, and return the chunk. The state stays as it is."""

    @abstractmethod
    def evaluate(self, learners: Learner, explore: bool, stream: Stream, num_episodes: int) -> dict[str, Any]:
        """Measure K fixed episodes of each seed's learner, [S, K], in the evaluation's task."""

    def close(self) -> None:  # noqa: B027 nothing is open where environments are compiled
        """Let go of what is open."""

    def learn(
        self,
        state: TrainState,
        carry: rollout.Carry,
        experience: rollout.Rollout,
        update_key: PRNGKey,
        key: PRNGKey,
    ) -> Update:
        """Learn from experience, and move the task on. carry: where the environments stand after it."""
        learner, metrics = self.algorithm.update(state.learner, experience, update_key)
        env_steps = (state.updates + 1) * (self.num_envs * self.num_steps)
        curriculum, env_params = self.curriculum.advance(state.curriculum, env_steps, experience)
        tally, episodes = self._count(state.tally, experience)
        finished = state.episodes + episodes.ended
        fault = find_fault(experience.transitions, state.updates) if self.watched else None
        state = TrainState(learner, carry, env_params, curriculum, tally, finished, key, state.updates + 1)
        return state, episodes, metrics, fault

    def _count(self, tally: Tally, experience: rollout.Rollout) -> tuple[Tally, EpisodeSummary]:
        """Follow the episodes of a rollout, and sum up those that ended in it."""
        fresh = no_steps(self.table)

        def one_step(tally: Tally, step: tuple[Any, Bool[Array, " E"]]):
            info, done = step
            tally = jax.vmap(count_step)(tally, info)
            episodes = jax.vmap(lambda tally: episode_metrics(tally, self.table))(tally)
            over = jax.vmap(lambda done, tally: jax.tree.map(lambda n, o: jnp.where(done, n, o), fresh, tally))
            return over(done, tally), episodes

        steps = experience.transitions
        inputs = (steps.info, steps.terminated | steps.truncated)
        if self.num_steps == 1:
            tally, episodes = one_step(tally, jax.tree.map(lambda leaf: leaf[0], inputs))
            episodes = episodes[None]
        else:
            tally, episodes = jax.lax.scan(one_step, tally, inputs)
        return tally, sum_up(episodes, inputs[1])

    def none_yet(self, state: TrainState, update: Any) -> Running:
        """Return a chunk before its first update, given the shapes of an `Update`."""
        _, _, *shapes = update
        zeros, unseen = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
        return Running(state, no_episodes(self.table), zeros, state.env_params, unseen)


def follow(running: Running, update: Update) -> Running:
    """Take in one more update."""
    state, episodes, metrics, fault = update
    seen = EpisodeSummary(
        ended=running.seen.ended + episodes.ended,
        total=running.seen.total + episodes.total,
        squares=running.seen.squares + episodes.squares,
        last=jnp.where(episodes.ended > 0, episodes.last, running.seen.last),
    )
    totals = jax.tree.map(jnp.add, running.totals, metrics)
    return Running(state, seen, totals, running.state.env_params, earlier(running.fault, fault))


def closed(running: Running, num_updates: Int[Array, ""]) -> tuple[TrainState, ChunkReport]:
    """Return the state after a chunk, and what the chunk showed."""
    metrics = jax.tree.map(lambda total: total / jnp.maximum(num_updates, 1), running.totals)
    return running.state, ChunkReport(running.seen, metrics, running.used, running.fault)


class Trainer(AbstractTrainer):
    """A trainer whose chunk is one program, environments included.

    `chunk` and `evaluate` compile once each; `num_updates` is data, so that a shorter last chunk does not
    compile again.
    """

    def make_chunk(self) -> Any:
        """Return the program, not yet compiled."""
        options = compiler_options(self.for_speed, self.algorithm.library_sums)
        chunk = map_seeds(self.chunk_of_one, self.mesh, in_place=True)
        return jax.jit(chunk, donate_argnums=0, compiler_options=options)

    def compiled(self, state: TrainState, num_updates: int) -> Chunk:
        """Compile a chunk of any length."""
        return self.chunk.lower(state, num_updates).compile()

    def _update(self, state: TrainState) -> Update:
        """Gather experience, learn from it, move the task on: one turn of the loop."""
        rollout_key, update_key, key = jax.random.split(state.key, 3)
        carry, experience = rollout.collect(
            self.env,
            self.algorithm.policy(state.learner, True),
            self.memory,
            state.env_params,
            share_out(state.carry),
            rollout_key,
            self.num_steps,
            self.intervention,
        )
        return self.learn(state, carry, experience, update_key, key)

    def chunk_of_one(self, state: TrainState, num_updates: Int[Array, ""]) -> tuple[TrainState, ChunkReport]:
        """Take `num_updates` turns of the loop, for one seed."""
        update = jax.jit(self._update, inline=True)  # traced once for the shapes and the loop
        start = self.none_yet(state, jax.eval_shape(update, state))
        running = jax.lax.fori_loop(
            0, num_updates, lambda _, running: follow(running, update(running.state)), start
        )
        return closed(running, num_updates)

    @partial(jax.jit, static_argnums=(0, 2, 3, 4))
    def evaluate(  # pyright: ignore[reportIncompatibleMethodOverride]
        self, learners: Learner, explore: bool, stream: Stream, num_episodes: int
    ) -> dict[str, Float[Array, "S K"]]:
        """Measure K fixed episodes of each seed's learner, in the evaluation's task."""
        env, params = self.evaluation_env, self.evaluation_params

        def one(learner: Learner) -> dict[str, Float[Array, " K"]]:
            policy, key = self.algorithm.policy(learner, explore), stream_key(stream)
            return evaluate(
                env, policy, self.memory, params, key, num_episodes, self.intervention, metrics=self.metrics
            )

        return map_seeds(one, self.mesh)(learners)

    @partial(jax.jit, static_argnums=(0, 2, 3, 4))
    def record(self, learner: Learner, stream: Stream, num_episodes: int, explore: bool = False) -> Played:
        """Record K episodes of one seed's learner as they happen, the very ones that `evaluate` measures."""
        return play(
            self.evaluation_env,
            self.algorithm.policy(learner, explore),
            self.memory,
            self.evaluation_params,
            stream_key(stream),
            num_episodes,
            self.intervention,
            self.look,
        )
