"""Compiled programs that play one policy one step at a time, for a number of places that agents can fill.

Who is there, what a hand moves and what happens to words are data: nothing of it compiles anything.
"""

from collections.abc import Callable, Generator
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from gacrl import rollout
from gacrl.envs.environment import Environment, EnvParams, EnvState
from gacrl.evaluation.episodes import Look, seen_of
from gacrl.evaluation.evaluate import stream_key
from gacrl.networks.agent import AgentNetwork
from gacrl.networks.graph import proximity_adjacency
from gacrl.networks.memory import restarted
from gacrl.scene import Edit, Placed, Scene
from gacrl.types import Arrives, Intervention, Learner, Memory, Observation, Policy, PRNGKey
from gacrl.viewer.insight import Insight, heard_of, insight

START, ACT, MOVE, NEWCOMERS = range(4)
"""What random numbers are drawn for."""


class Meddling(NamedTuple):
    """What happens to the words of one step, in one environment."""

    values: Float[Array | np.ndarray, "R N V"]
    replaced: Bool[Array | np.ndarray, "R N"]
    other: Int[Array | np.ndarray, " N"]
    """With whose words each agent is heard: its own, or another one's."""
    kept: Bool[Array | np.ndarray, "N N"]
    radius: Float[Array | np.ndarray, ""] | float
    """Within which agents hear each other, where the task has space and the network a radius."""

    @classmethod
    def none(cls, words: tuple[int, int, int]) -> "Meddling":
        """Let everything arrive as it is said: [R, N, V] of it."""
        rounds, agents, _ = words
        return cls(
            values=np.zeros(words, np.float32),
            replaced=np.zeros((rounds, agents), bool),
            other=np.arange(agents),
            kept=np.ones((agents, agents), bool),
            radius=0.0,
        )


class Stood(NamedTuple):
    """Where an environment stands before its agents decide."""

    state: EnvState
    seen: Observation
    memory: Memory
    first: bool


class Decided(NamedTuple):
    """What they decide there, and what there is to see."""

    memory: Memory
    action: Array
    messages: Float[Array, "R N V"] | None
    hears: Bool[Array, "N N"] | None
    """Whom each agent listens to."""
    scene: Scene
    insight: Insight | None
    """How they came to it; None for a policy that cannot say."""


class Happened(NamedTuple):
    """What a step brought."""

    reward: Float[Array, ""]
    measured: dict[str, Float[Array, ""]]
    over: Bool[Array, ""]


class Playable(NamedTuple):
    """A policy in an environment, apart from its parameters."""

    env: Environment
    policy: Callable[[Learner], Policy]
    """What scripted policies learn is ()."""
    memory: Memory
    network: Callable[[Learner], AgentNetwork] | None = None
    """That decides; None where nobody can be asked how a decision came about."""


class Customs(NamedTuple):
    """What a task and a policy have to do with a page."""

    look: Look | None
    """What is to be seen of a state."""
    measures: tuple[str, ...] = ()
    """Which measurements of a step are told."""
    edit: Callable[[EnvState, Edit], EnvState] | None = None
    """What a hand may move."""
    join: Callable[[EnvState, EnvState, Any, Any], EnvState] | None = None
    """(state, a fresh one, agents before, now) -> the state with newcomers; None where nobody comes or goes."""
    reach: bool = False
    """The network's radius decides who hears whom."""
    nearest: int | None = None
    """So many neighbours an agent listens to at the most; None: all."""


class Room:
    """A policy in an environment with a fixed number of places."""

    def __init__(self, playable: Playable, customs: Customs) -> None:
        env, memory, edit = playable.env, playable.memory, customs.edit
        self.env, self.memory, self.places = env, _strong(memory), int(env.num_agents)
        self._reset = _compiled(partial(_reset, env))
        self._step = _compiled(partial(_step, env, memory, customs.measures))
        self._decide = _compiled(partial(_decide, playable, customs))  # with meddling, and without: two programs
        self._edit = None if edit is None else _compiled(partial(_edited, env, edit))
        self._join = None if customs.join is None else _compiled(partial(_joined, env, customs.join))
        self.marks = 0
        """Marks of its scene."""
        self.words: tuple[int, int, int] | None = None
        """[R, N, V] of what is said in a step; None for a policy that says nothing."""

    def reset(self, params: EnvParams, seed: int) -> Stood:
        """Begin an episode."""
        state, seen = self._reset(params, seed)
        return Stood(state, seen, self.memory, True)

    def step(
        self, params: EnvParams, state: EnvState, decided: Decided, seed: int, t: int
    ) -> tuple[Stood, Happened]:
        """Step, by what was decided in step t."""
        state, seen, memory, happened = self._step(params, state, decided.action, decided.memory, seed, t)
        return Stood(state, seen, memory, False), happened

    def edited(self, params: EnvParams, stood: Stood, hand: Edit) -> Stood:
        """Let a hand move things. Agents see it at once, where the task can say what they see in a state."""
        if self._edit is None:
            return stood
        state, seen = self._edit(params, stood.state, hand)
        return stood._replace(state=state, seen=stood.seen if seen is None else seen)

    def joined(self, params: EnvParams, state: EnvState, before: int, now: int, seed: int, t: int) -> Stood:
        """Return how a state stands here after agents have come or gone in step t: nobody remembers anything.

        state: of this room or of a smaller one.
        """
        assert self._join is not None, "only a task with a team has agents that come and go"
        here = grown(jax.device_get(state), jax.eval_shape(self._reset, params, seed)[0])
        state, seen = self._join(params, here, before, now, seed, t)
        assert seen is not None, "a task with a team says what is seen in a state"
        return Stood(state, seen, self.memory, True)

    def decide(
        self, learner: Learner, params: EnvParams, stood: Stood, seed: int, t: int, meddling: Meddling | None
    ) -> Decided:
        """Let the agents decide in step t."""
        return self._decide(learner, params, stood.state, stood.seen, stood.memory, stood.first, seed, t, meddling)

    def drawn(self, state: EnvState) -> None:
        """Return nothing: the page draws the scene."""

    def measure(self, learner: Learner, params: EnvParams) -> None:
        """Find out how much there is to see and to hear; nothing is computed."""
        stood = jax.eval_shape(self._reset, params, 0)
        found = jax.eval_shape(self._decide, learner, params, *stood, self.memory, True, 0, 0, None)
        self.marks = found.scene.marks.radius.shape[0]
        self.words = None if found.messages is None else found.messages.shape

    def warm(self, learner: Learner, params: EnvParams) -> Generator[None]:
        """Compile all programs by playing a step, so that nobody waits for them later: one after the other.

        First what answers a visitor who lets agents come, then what goes on from there.
        """
        stood = self.reset(params, 0)
        yield
        if self._join is not None:
            stood = self.joined(params, stood.state, self.places, self.places, 0, 0)
            yield
        decided = self.decide(learner, params, stood, 0, 0, None)
        yield
        stood, _ = self.step(params, stood.state, decided, 0, 0)
        yield
        if self.words is not None:
            self.decide(learner, params, stood, 0, 1, Meddling.none(self.words))
            yield
        if self._edit is not None:
            placed = (
                Placed(np.zeros((count, 2), np.float32), np.zeros(count, bool))
                for count in (self.places, self.marks)
            )
            self.edited(params, stood, Edit(*placed))


def grown(state: EnvState, like: EnvState) -> EnvState:
    """Return a state on the host at the beginning of arrays as large as those of another one."""

    def grow(old: Any, new: Any) -> Any:
        if np.shape(old) == np.shape(new):
            return old
        larger = np.zeros(new.shape, new.dtype)
        larger[tuple(slice(0, size) for size in np.shape(old))] = old
        return larger

    return jax.tree.map(grow, state, like)


def _compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile it. No result is weakly typed, as a bare 0 is: one program then serves whoever passes it on."""
    return jax.jit(lambda *given: _strong(function(*given)))


def _strong(tree: Any) -> Any:
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.asarray(leaf).dtype), tree)


def _key(seed: Any, t: Any, purpose: Any) -> PRNGKey:
    return jax.random.fold_in(jax.random.fold_in(jax.random.fold_in(stream_key("view"), seed), t), purpose)


def _reset(
    env: Environment, params: EnvParams, seed: Any, t: Any = 0, purpose: Any = START
) -> tuple[EnvState, Observation]:
    return env.reset(_key(seed, t, purpose), params)


def _step(
    env: Environment,
    fresh: Memory,
    measures: tuple[str, ...],
    params: EnvParams,
    state: EnvState,
    action: Array,
    memory: Memory,
    seed: Any,
    t: Any,
) -> tuple[EnvState, Observation, Memory, Happened]:
    state, after = env.step(state, action, _key(seed, t, MOVE), params)
    info = rollout.measured(after)
    memory = memory if after.left is None else restarted(fresh, memory, after.left)
    told = {name: info[name] for name in measures}
    return state, after.observation, memory, Happened(info["reward_raw"], told, after.terminated | after.truncated)


def _joined(
    env: Environment,
    join: Callable[[EnvState, EnvState, Any, Any], EnvState],
    params: EnvParams,
    state: EnvState,
    before: Any,
    now: Any,
    seed: Any,
    t: Any,
) -> tuple[EnvState, Observation | None]:
    fresh, _ = _reset(env, params, seed, t, NEWCOMERS)
    state = join(state, fresh, before, now)
    return state, env.seen_in(state, params)


def _edited(
    env: Environment,
    edit: Callable[[EnvState, Edit], EnvState],
    params: EnvParams,
    state: EnvState,
    hand: Edit,
) -> tuple[EnvState, Observation | None]:
    state = edit(state, hand)
    return state, env.seen_in(state, params)


def _decide(
    playable: Playable,
    customs: Customs,
    learner: Learner,
    params: EnvParams,
    state: EnvState,
    seen: Observation,
    memory: Memory,
    first: Any,
    seed: Any,
    t: Any,
    meddling: Meddling | None,
) -> Decided:
    listening = seen
    if meddling is not None and customs.reach and seen.positions is not None:
        near = proximity_adjacency(seen.positions, seen.agent_mask, jnp.asarray(meddling.radius))
        listening = seen._replace(adjacency=near)
    alone = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], (state, listening, memory, first, meddling))
    carry = rollout.Carry(*alone[:4], intervention=alone[4])
    keys = jax.random.split(_key(seed, t, ACT), (1, 3))
    happens = None if meddling is None else _MEDDLING
    decided, decision = rollout.decide(playable.policy(learner), carry, keys, happens)
    scene = seen_of(customs.look, carry.env_state, carry.observation, params)
    assert scene is not None, "whoever opens a policy asks whether there is something to see"
    after, chosen, shown, listened = jax.tree.map(
        lambda leaf: leaf[0], (decided.memory, decision._replace(extras=()), scene, decided.observation)
    )
    hears, asked = chosen.adjacency, None
    if hears is not None:
        hears, _ = heard_of(listened, hears, customs.nearest)
    if playable.network is not None:
        network = playable.network(learner)
        asked = insight(playable.env, network, memory, listened, chosen.messages, shown)
    return Decided(after, chosen.action, chosen.messages, hears, shown, asked)


def _arrives(state: Meddling, ask: Callable[[Arrives], Array], first: Array, key: PRNGKey) -> Arrives:
    """Let words arrive round by round: what is said in a round depends on what was heard in the one before."""
    values, replaced, other, kept = map(jnp.asarray, (state.values, state.replaced, state.other, state.kept))
    swapped = other != jnp.arange(other.shape[1])[None]
    for number in range(values.shape[1]):
        said = ask(Arrives(values, replaced, kept))[:, number]
        theirs = jnp.take_along_axis(said, other[..., None], axis=1)
        values = values.at[:, number].set(jnp.where(swapped[..., None], theirs, values[:, number]))
        replaced = replaced.at[:, number].set(replaced[:, number] | swapped)
    return Arrives(values, replaced, kept)


_MEDDLING = Intervention("meddling", _arrives)
