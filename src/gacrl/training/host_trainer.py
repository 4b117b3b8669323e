"""Training on environments that live in Python: programs decide and learn, the host steps and calls them in turn.

The same functions as `Trainer`, and the same `Rollout` for algorithms. No program calls back into Python.
"""

from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from gacrl import rollout
from gacrl.config.checks import require
from gacrl.envs.environment import TimeStep
from gacrl.envs.hosted import Hosted
from gacrl.evaluation import on_host
from gacrl.evaluation.evaluate import Stream, stream_key
from gacrl.evaluation.metrics import no_steps
from gacrl.hosting import Left, Stage, decider, seeds_from
from gacrl.rollout import Carry
from gacrl.training.devices import compiler_options, one_seed, shard_seeds, stack_seeds
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
    left: Left
    """Whose life ended with the last step."""


class HostTrainer(AbstractTrainer):
    """A trainer that keeps copies of the environment open from chunk to chunk, and trains one seed after the other.

    A state that it did not return itself (a fresh one, one of a checkpoint) begins with new episodes: what is inside
    an environment is in no state.
    """

    def make_chunk(self) -> Any:
        """Return the function that plays and learns by turns."""
        require(
            jax.process_count() == 1,
            f"{type(self.env).__name__} lives in Python: train it in one process, without --distributed",
        )
        options = compiler_options(self.for_speed, self.algorithm.library_sums)
        self._decide = jax.jit(self._decided, compiler_options=options)
        self._learn = jax.jit(
            lambda running, played: follow(running, self._updated(running.state, played)),
            donate_argnums=0,
            compiler_options=options,
        )
        self._open = jax.jit(
            lambda state, played: self.none_yet(state, jax.eval_shape(self._updated, state, played)),
            donate_argnums=0,
        )
        self._close = jax.jit(closed, donate_argnums=0)
        self._anew = jax.jit(self._beginning, donate_argnums=0)
        self._stages: dict[int, Stage] = {}
        self._latest: TrainState | None = None
        return self._chunk

    def compiled(self, state: TrainState, num_updates: int) -> Chunk:
        """Play and learn once, of a copy of the first seed: each program is compiled when it is first called."""
        jax.block_until_ready(self._chunk_of_one(one_seed(state, 0), 1, self._standing(0), anew=True))
        self._latest = None
        return self._chunk

    def _chunk(self, state: TrainState, num_updates: int) -> tuple[TrainState, ChunkReport]:
        """`num_updates` turns of the loop, for each seed in turn."""
        anew, self._latest = state is not self._latest, None
        done = [
            self._chunk_of_one(one_seed(state, seed), num_updates, self._standing(seed), anew)
            for seed in range(self.num_seeds)
        ]
        self._latest, report = shard_seeds(stack_seeds(done), self.mesh)
        assert self._latest is not None
        return self._latest, report

    def _standing(self, seed: int) -> Stage:
        """The copies in which the environments of a seed are."""
        if seed not in self._stages:
            assert isinstance(self.env, Hosted)
            self._stages[seed] = Stage(self.env, self.num_envs)
        return self._stages[seed]

    def _chunk_of_one(
        self, state: TrainState, num_updates: int, stage: Stage, anew: bool
    ) -> tuple[TrainState, ChunkReport]:
        """anew: begin with new episodes."""
        if anew:
            stage.begin(seeds_from(state.key, self.num_envs))
            state = self._anew(state)
        running: Running | None = None
        for _ in range(num_updates):
            played = self._play(stage, state if running is None else running.state)
            running = self._open(state, played) if running is None else running
            running = self._learn(running, played)
        assert running is not None, "a chunk has at least one update"
        return self._close(running, num_updates)

    def _play(self, stage: Stage, state: TrainState) -> Played:
        """Take T steps."""
        carry, steps, after = state.carry, list[tuple[Carry, Decision]](), list[TimeStep]()
        acting = self.algorithm.acting(state.learner)
        for step in range(self.num_steps):
            carry, decision = self._decide(acting, stage.carry(carry), stage.left, state.key, np.int32(step))
            after.append(stage.step(decision))
            steps.append((carry._replace(memory=(), intervention=()), decision))
        stacked = jax.tree.map(lambda *rows: np.stack(rows), *after)
        return Played(steps, stacked, stage.carry(carry), stage.left)

    def close(self) -> None:
        """End the processes of the environments, where they have some."""
        for env in (self.env, self.evaluation_env):
            assert isinstance(env, Hosted)
            env.close()

    def _decided(
        self, learner: Learner, carry: Carry, left: Left, key: PRNGKey, step: Int[Array, ""]
    ) -> tuple[Carry, Decision]:
        rollout_key, _, _ = jax.random.split(key, 3)
        policy = self.algorithm.policy(learner, True)
        return decider(policy, self.memory, self.num_steps, self.intervention)(carry, left, rollout_key, step)

    def _updated(self, state: TrainState, played: Played) -> Update:
        _, update_key, key = jax.random.split(state.key, 3)
        decided, decisions = jax.tree.map(lambda *rows: jnp.stack(rows), *played.steps)
        carry = rollout.forgetting(self.memory, played.end, played.left)
        transitions = rollout.happened(decided, decisions, played.after)
        experience = Rollout(transitions, state.carry.memory)
        return self.learn(state, carry, experience, update_key, key)

    def _beginning(self, state: TrainState) -> TrainState:
        """The state with every environment before an episode's first step."""
        carry = state.carry._replace(first=jnp.ones_like(state.carry.first))
        tally = jax.vmap(lambda _: no_steps(self.table))(jnp.arange(self.num_envs))
        return state._replace(carry=rollout.forgetting(self.memory, carry, None), tally=tally)

    def evaluate(
        self, learners: Learner, explore: bool, stream: Stream, num_episodes: int
    ) -> dict[str, Float[np.ndarray, "S K"]]:
        """Measure K fixed episodes of each seed's learner, one learner after the other."""
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
