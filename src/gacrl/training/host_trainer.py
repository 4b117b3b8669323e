"""Training on environments that live in Python: programs decide and learn, the host steps and calls them in turn.

The same functions as `Trainer`, and the same `Rollout` for algorithms. No program calls back into Python.
"""

from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from gacrl import rollout
from gacrl.config.checks import require
from gacrl.envs.environment import TimeStep
from gacrl.envs.hosted import Hosted
from gacrl.evaluation import on_host
from gacrl.evaluation.evaluate import Stream, stream_key
from gacrl.evaluation.metrics import no_steps
from gacrl.hosting import Stage, decider, seeds_from
from gacrl.rollout import Carry
from gacrl.training.devices import compiler_options, map_seeds, one_seed
from gacrl.training.trainer import AbstractTrainer, Chunk, ChunkReport, Running, TrainState, Update, closed, follow
from gacrl.types import Decision, Learner, PRNGKey, Rollout


class Played(NamedTuple):
    """What the agents and the host did in T steps, to be learned from."""

    steps: list[tuple[Carry, Decision]]
    """Of each step: what was seen and heard, without memory, and what was decided; on the device."""
    after: TimeStep
    """What the steps brought, [T, E, …], from the host."""
    end: Carry
    """Where the environments stand then; memory is not yet renewed."""
    left: Bool[Array, "E N"]
    """Whose life ended with the last step."""


class HostTrainer(AbstractTrainer):
    """A trainer that keeps copies of the environment open from chunk to chunk.

    A state that it did not return itself (a fresh one, one of a checkpoint) begins with new episodes: what is inside
    an environment is in no state.
    """

    def make_chunk(self) -> Any:
        """Return the function that plays and learns by turns."""
        require(
            jax.process_count() == 1,
            f"{type(self.env).__name__} lives in Python: train it in one process, without --distributed",
        )
        options = compiler_options(self.for_speed)
        learned, opened = map_seeds(self._learn_of_one, self.mesh), map_seeds(self._open_of_one, self.mesh)
        self._decide = jax.jit(map_seeds(self._decide_of_one, self.mesh), compiler_options=options)
        self._learn = jax.jit(
            lambda running, played: learned((running, played)), donate_argnums=0, compiler_options=options
        )
        self._open = jax.jit(lambda state, played: opened((state, played)), donate_argnums=0)
        self._close = jax.jit(map_seeds(closed, self.mesh), donate_argnums=0)
        self._anew = jax.jit(map_seeds(self._anew_of_one, self.mesh), donate_argnums=0)
        self._stage: Stage | None = None
        self._latest: TrainState | None = None
        return self._chunk

    def compiled(self, state: TrainState, num_updates: int) -> Chunk:
        """Play and learn once, of a copy of the state: each program is compiled when it is first called."""
        jax.block_until_ready(self._chunk(jax.tree.map(jnp.copy, state), 1))
        self._latest = None
        return self._chunk

    def _chunk(self, state: TrainState, num_updates: int) -> tuple[TrainState, ChunkReport]:
        stage, state = self._standing(state)
        running: Running | None = None
        for _ in range(num_updates):
            now = state if running is None else running.state
            played = self._play(stage, now)
            running = self._open(now, played) if running is None else running
            running = self._learn(running, played)
        assert running is not None, "a chunk has at least one update"
        self._latest, report = self._close(running, num_updates)
        assert self._latest is not None
        return self._latest, report

    def _standing(self, state: TrainState) -> tuple[Stage, TrainState]:
        """The copies in which this state stands; new episodes in them where it is not the latest one."""
        members = state.updates.shape[0]
        if self._stage is None:
            assert isinstance(self.env, Hosted)
            self._stage = Stage(self.env, members, self.num_envs)
        if state is not self._latest:
            self._stage.begin([seed for member in range(members) for seed in self._seeds(state, member)])
            state = self._anew(state)
        return self._stage, state

    def _seeds(self, state: TrainState, member: int) -> list[int]:
        """The seeds of the copies of one member, whoever else is trained."""
        return seeds_from(one_seed(state.key, member), self.num_envs)

    def _play(self, stage: Stage, state: TrainState) -> Played:
        """Take T steps."""
        carry, steps, after = state.carry, list[tuple[Carry, Decision]](), list[TimeStep]()
        for step in range(self.num_steps):
            acting = self.algorithm.acting(state.learner)
            seen = (acting, stage.carry(carry), stage.left, state.key)
            carry, decision = self._decide(seen, np.int32(step))
            after.append(stage.step(decision))
            steps.append((carry._replace(memory=(), intervention=()), decision))
        stacked = jax.tree.map(lambda *rows: np.stack(rows, axis=1), *after)
        return Played(steps, stacked, stage.carry(carry), stage.left)

    def _decide_of_one(
        self, seen: tuple[Learner, Carry, Array, PRNGKey], step: Int[Array, ""]
    ) -> tuple[Carry, Decision]:
        learner, carry, left, key = seen
        rollout_key, _, _ = jax.random.split(key, 3)
        policy = self.algorithm.policy(learner, True)
        return decider(policy, self.memory, self.num_steps, self.intervention)(carry, left, rollout_key, step)

    def _learn_of_one(self, given: tuple[Running, Played]) -> Running:
        running, played = given
        return follow(running, self._updated(running.state, played))

    def _open_of_one(self, given: tuple[TrainState, Played]) -> Running:
        state, played = given
        return self.none_yet(state, jax.eval_shape(self._updated, state, played))

    def _updated(self, state: TrainState, played: Played) -> Update:
        _, update_key, key = jax.random.split(state.key, 3)
        decided, decisions = jax.tree.map(lambda *rows: jnp.stack(rows), *played.steps)
        carry = rollout.forgetting(self.memory, played.end, played.left)
        transitions = rollout.happened(decided, decisions, played.after)
        experience = Rollout(transitions, state.carry.memory, carry.memory)
        return self.learn(state, carry, experience, update_key, key)

    def _anew_of_one(self, state: TrainState) -> TrainState:
        """The state with every environment before an episode's first step."""
        carry = state.carry._replace(first=jnp.ones_like(state.carry.first))
        tally = jax.vmap(lambda _: no_steps(self.table))(jnp.arange(self.num_envs))
        return state._replace(carry=rollout.forgetting(self.memory, carry, None), tally=tally)

    def evaluate(
        self, learners: Learner, explore: bool, stream: Stream, num_episodes: int
    ) -> dict[str, Float[np.ndarray, "S K"]]:
        """The metrics of K fixed episodes of each seed's learner, one learner after the other."""
        assert isinstance(self.evaluation_env, Hosted)
        played: list[dict[str, np.ndarray]] = []
        for member in range(self.num_seeds):
            learner = one_seed(learners, member)
            decide = partial(self._deciding(explore), learner)
            actors = on_host.Actors(
                self.algorithm.policy(learner, explore), self.memory, self.intervention, decide
            )
            key = stream_key(stream)
            played.append(on_host.evaluate(self.evaluation_env, actors, key, num_episodes, self.metrics))
        return {name: np.stack([metrics[name] for metrics in played]) for name in played[0]}

    @cache  # noqa: B019 a trainer lives as long as its run
    def _deciding(self, explore: bool) -> Any:
        """The device's half of a step of an evaluation, with the learner as data: it compiles once."""

        def decide(learner: Learner, *seen: Any) -> tuple[Carry, Decision]:
            policy, steps = self.algorithm.policy(learner, explore), self.evaluation_env.max_cycles
            return decider(policy, self.memory, steps, self.intervention)(*seen)

        return jax.jit(decide)
