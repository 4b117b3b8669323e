"""What can be done to messages on their way: silence, swap, scramble, drop, delay and noise, and words of one's own.

Each makes an `Intervention`: it says what arrives, `gacrl.rollout` lets it arrive, in training, evaluation and
recording alike. Where the words of a step are needed before they arrive, the agents are asked round by round, since
what they say in a round depends on what they heard in the one before.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from gacrl.config.checks import require, typed, unknown, whole
from gacrl.errors import ConfigError
from gacrl.types import Arrives, Intervention, PRNGKey, Words

Ask: TypeAlias = Callable[[Arrives], Words]
RoundOfWords: TypeAlias = Float[Array, "E N V"]
Shape: TypeAlias = Words | Float[jax.ShapeDtypeStruct, "E R N V"]
"""What an intervention begins with: of the words, their shape alone is known."""


def silence(agents: Sequence[int] | int | None = None) -> Intervention:
    """Let nobody hear these agents (or this one), counted from 0; by default nobody hears anybody.

    Raises ConfigError for no agent, or what is no number; in play, for an agent that is not there.
    """
    silenced = [] if agents is None else [_agent("silence", agent) for agent in np.atleast_1d(agents)]
    require(agents is None or len(silenced) > 0, "silence: name an agent, or give no list to silence all")

    def init(words: Shape) -> Any:
        _require_agents("silence", silenced, words)
        return ()

    def arrives(state: Any, ask: Ask, first: Bool[Array, " E"], key: PRNGKey) -> Arrives:
        num_envs, _, num_agents, _ = _shape(ask)
        muted = jnp.ones(num_agents, bool)
        if agents is not None:
            muted = jnp.zeros(num_agents, bool).at[jnp.asarray(silenced, int)].set(True)
        return Arrives(kept=jnp.broadcast_to(~muted, (num_envs, num_agents, num_agents)))

    heard = "nobody hears anybody" if agents is None else f"nobody hears {_named(silenced)}"
    return Intervention("silence", arrives, init, told=heard)


def swap(one: int, other: int) -> Intervention:
    """Let each of the two agents be heard with the words of the other.

    Raises ConfigError for what is no number; in play, for an agent that is not there.
    """
    one, other = _agent("swap", one), _agent("swap", other)

    def init(words: Shape) -> Any:
        _require_agents("swap", (one, other), words)
        return ()

    def swapped(said: RoundOfWords) -> RoundOfWords:
        return said.at[:, (one, other)].set(said[:, (other, one)])

    told = f"{_named((one, other))} are heard with each other's words"
    return Intervention("swap", _round_by_round(swapped), init, told=told)


def scramble() -> Intervention:
    """Let every agent be heard with its own words from the next of the episodes that are played side by side.

    The words keep their frequencies and their order in time, and say nothing about what goes on here. Raises
    ConfigError for a single episode.
    """

    def init(words: Shape) -> Any:
        require(words.shape[0] > 1, "to scramble messages takes at least two episodes side by side")
        return ()

    moved = _round_by_round(lambda said: jnp.roll(said, 1, axis=0))
    return Intervention("scramble", moved, init, told="every agent is heard with its words from another episode")


def drop(probability: float) -> Intervention:
    """Let each edge lose what is said along it in a step, all rounds of it, with this probability.

    Raises ConfigError for what is no probability.
    """
    probability = _share("drop", probability)

    def arrives(state: Any, ask: Ask, first: Bool[Array, " E"], key: PRNGKey) -> Arrives:
        num_envs, _, num_agents, _ = _shape(ask)
        return Arrives(kept=jax.random.bernoulli(key, 1.0 - probability, (num_envs, num_agents, num_agents)))

    return Intervention(
        "drop", arrives, told=f"each edge loses its messages in {100 * probability:g} % of the steps"
    )


def noise(probability: float) -> Intervention:
    """Replace each word by a symbol drawn at random with this probability; a hidden vector by a one-hot one.

    Raises ConfigError for what is no probability.
    """
    probability = _share("noise", probability)

    def arrives(state: Any, ask: Ask, first: Bool[Array, " E"], key: PRNGKey) -> Arrives:
        *words, symbols = _shape(ask)
        replaced_key, symbol_key = jax.random.split(key)
        random = jax.random.randint(symbol_key, words, 0, symbols)
        return Arrives(jax.nn.one_hot(random, symbols), jax.random.bernoulli(replaced_key, probability, words))

    return Intervention("noise", arrives, told=f"{100 * probability:g} % of the words are replaced by random ones")


class _Late(NamedTuple):
    """Words on their way."""

    words: Float[Array, "K E R N V"]
    """What was said in each of the K steps before, the last one first."""
    step: Int[Array, " E"]
    """Steps since the episode began."""


def delay(steps: int) -> Intervention:
    """Let words arrive this many environment steps after they were said; in an episode's first steps nothing arrives.

    Where agents come and go, who takes another one's place is heard with the words of the one before. Raises
    ConfigError for what is no number of steps from 1 to 1,000.
    """
    steps = whole(steps, "delay")
    require(1 <= steps <= 1_000, f"delay must be a whole number of steps between 1 and 1000, not {steps}")

    def init(words: Shape) -> _Late:
        return _Late(jnp.zeros((steps, *words.shape)), jnp.zeros(words.shape[0], jnp.int32))

    def arrives(state: _Late, ask: Ask, first: Bool[Array, " E"], key: PRNGKey) -> Arrives:
        num_envs, _, num_agents, _ = state.words.shape[1:]
        there = jnp.where(first, 0, state.step) >= steps
        values = jnp.where(there[:, None, None, None], state.words[-1], 0.0)
        return Arrives(values, kept=jnp.broadcast_to(there[:, None, None], (num_envs, num_agents, num_agents)))

    def follow(state: _Late, said: Words, first: Bool[Array, " E"]) -> _Late:
        return _Late(jnp.concatenate([said[None], state.words[:-1]]), jnp.where(first, 0, state.step) + 1)

    late = f"words arrive {steps} step{'s' * (steps > 1)} late"
    return Intervention("delay", arrives, init, follow, late)


INTERVENTIONS: dict[str, tuple[Callable[..., Intervention], str]] = {
    "silence": (lambda *agents: silence(agents or None), "silence [AGENT …]"),
    "swap": (swap, "swap AGENT AGENT"),
    "scramble": (scramble, "scramble"),
    "drop": (drop, "drop PROBABILITY"),
    "delay": (delay, "delay STEPS"),
    "noise": (noise, "noise PROBABILITY"),
}
"""By name: what makes one, and how it is written."""


def parse(text: str) -> Intervention | None:
    """Read `silence`, `silence 0 2`, `swap 0 1`, `scramble`, `drop 0.2`, `delay 3` or `noise 0.1`; None for nothing.

    Raises ConfigError for anything else.
    """
    if not text.strip():
        return None
    name, *words = text.split()
    require(name in INTERVENTIONS, unknown("intervention", name, INTERVENTIONS))
    make, written = INTERVENTIONS[name]
    try:
        return make(*(float(word) if name in ("drop", "noise") else int(word) for word in words))
    except ConfigError:
        raise
    except (TypeError, ValueError):
        raise ConfigError(f"{text!r} is no intervention: write it as `{written}`") from None


def of(what: Any) -> Intervention | None:
    """Return the intervention that an argument stands for: itself, in words, or what arrives in every environment.

    Raises ConfigError for anything else.
    """
    if what is None or isinstance(what, Intervention):
        return what
    if isinstance(what, str):
        return parse(what)
    if isinstance(what, Arrives):
        return arriving(what)
    raise ConfigError(f"what arrives must be an intervention such as gacrl.silence(), not {what!r}")


def arriving(what: Arrives) -> Intervention:
    """Let the same words arrive at every step, and along the same edges.

    They are those of one environment, [R, N, V] and [N, N].
    """

    def arrives(state: Any, ask: Ask, first: Bool[Array, " E"], key: PRNGKey) -> Arrives:
        return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (first.shape[0], *leaf.shape)), what)

    return Intervention("replace", arrives, told="the same words arrive at every step")


def example(text: str, words: Callable[[], tuple[int, ...] | None]) -> Arrives:
    """Return zeros in the shapes of what arrives in one environment where `parse(text)` intervenes.

    words: the shape [R, N, V] of what is said in a step; None where nothing is.
    """
    intervention = parse(text)
    if intervention is None:
        return Arrives()
    shape = words()
    require(shape is not None, f"the agents say nothing: there are no messages to {intervention.name}")

    def one() -> Arrives:
        said, first = jnp.zeros((2, *(shape or ()))), jnp.zeros(2, bool)
        return intervention.arrives(intervention.init(said), lambda _: said, first, jax.random.key(0))

    return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape[1:], leaf.dtype), jax.eval_shape(one))


def _round_by_round(change: Callable[[RoundOfWords], RoundOfWords]) -> Callable[..., Arrives]:
    """What arrives of each round is `change` of what is said in it, by agents that heard the rounds before so."""

    def arrives(state: Any, ask: Ask, first: Bool[Array, " E"], key: PRNGKey) -> Arrives:
        shape = _shape(ask)
        values, replaced = jnp.zeros(shape), jnp.zeros(shape[:3], bool)
        for number in range(shape[1]):
            said = ask(Arrives(values, replaced))[:, number]
            values, replaced = values.at[:, number].set(change(said)), replaced.at[:, number].set(True)
        return Arrives(values, replaced)

    return arrives


def _shape(ask: Ask) -> tuple[int, int, int, int]:
    """[E, R, N, V]; nothing is computed."""
    return jax.eval_shape(ask, Arrives()).shape


def _named(agents: Sequence[int]) -> str:
    """Write agents in words: agent 0; agents 0, 1 and 2."""
    *others, last = map(str, agents)
    return f"agents {', '.join(others)} and {last}" if others else f"agent {last}"


def _require_agents(name: str, agents: Sequence[int], words: Shape) -> None:
    num_agents = words.shape[2]
    for agent in agents:
        require(
            0 <= agent < num_agents,
            f"{name}: there are the agents 0 to {num_agents - 1}, and no agent {agent}",
        )


def _agent(name: str, agent: Any) -> int:
    return whole(agent, f"an agent to {name}")


def _share(name: str, probability: Any) -> float:
    probability = typed(probability, float, name)
    require(0.0 <= probability <= 1.0, f"{name} must be a probability between 0 and 1, not {probability!r}")
    return probability
