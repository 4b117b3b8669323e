"""The loss of Q-learning from replay: networks looked along windows, n-step targets, double Q-learning.

W steps of a window are replayed, the first L of which are learned from; M values are learned: the team's, or each
agent's. Double Q-learning is van Hasselt et al. 2016.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from gacrl.algorithms.actions import greedy
from gacrl.algorithms.objectives import HUBER_DELTA, RewardNorm, huber
from gacrl.algorithms.q_learner import Experience, LearnerState, Network, Setup
from gacrl.algorithms.returns import n_step_window, next_values
from gacrl.algorithms.shared import share_reward
from gacrl.algorithms.teaching import as_told, lesson
from gacrl.networks.agent import AgentNetwork, AgentOutput, unroll
from gacrl.networks.memory import beginnings, restarted
from gacrl.types import Memory, Metrics, Observation, Transition


class Pair(NamedTuple):
    """The network that learns and the one that values, and how soft symbols are at the moment."""

    network: Network
    target: Network
    temperature: Float[Array, ""] | float


class Looks(NamedTuple):
    """Hold what networks make of windows: what they put out, and their memory after each step."""

    online: tuple[AgentOutput, Memory]
    """Of the network that learns from rewards; without a memory, of the steps that are learned from."""
    theirs: tuple[AgentOutput, Memory] | None
    """Of the target network; None without a memory."""
    pupil: AgentOutput | None
    """Of a teacher's pupils; None where nobody is taught."""


def along(
    network: AgentNetwork, steps: Transition, memory: Memory, keys: Array | None, temperature: Array | float
) -> tuple[AgentOutput, Memory]:
    """Unroll a network along windows [W, B, …]; keys and memory [B, …]."""
    length = steps.first.shape[0]
    drawn = None if keys is None else jax.vmap(lambda key: jax.random.split(key, length), 0, 1)(keys)
    begins = jax.vmap(beginnings, 1, 1)(steps.first, steps.left)
    return unroll(network, steps.observation, begins, memory, drawn, temperature)


def look(q: Setup, pair: Pair, steps: Experience, keys: Array) -> Looks:
    """Unroll the networks along windows [W, B, …]; keys [B]."""
    network, heard, learned = pair.network, steps.transition, q.config.sequence_length
    seen = heard if network.teacher is None else as_told(heard)
    memory = jax.tree.map(lambda leaf: leaf[0], steps.memory)
    if q.config.augment:  # what is remembered is not turned
        memory = jax.tree.map(jnp.zeros_like, memory)
    pupil = None
    if network.teacher is not None:
        now = jax.tree.map(lambda leaf: leaf[:learned], heard)
        pupil = along(network.agent, now, memory, keys, pair.temperature)[0]
    if q.forgetful:
        now = jax.tree.map(lambda leaf: leaf[:learned], seen)
        return Looks(along(network.judge, now, (), keys, pair.temperature), None, pupil)
    # What a teacher remembers is not kept.
    before = memory if network.teacher is None else jax.tree.map(jnp.zeros_like, memory)
    online = along(network.judge, seen, before, keys, pair.temperature)
    return Looks(online, along(pair.target.judge, seen, before, None, pair.temperature), pupil)


def best_value(
    q: Setup, target: Network, theirs: AgentOutput, chooser: AgentOutput, observation: Observation
) -> Float[Array, " M"]:
    """Return the target network's value of the actions that are best: by the online network with double Q."""
    best = greedy((chooser if q.config.double_q else theirs).head, q.actions.mask(observation.action_mask))
    return q.parts.team_value(target, theirs, best, observation)


def bootstrap(
    q: Setup, pair: Pair, observation: Observation, memory: Memory, target_memory: Memory
) -> Float[Array, " M"]:
    """Return the same of an observation that is yet to be looked at."""
    theirs = pair.target.judge(observation, target_memory, temperature=pair.temperature)[0]
    chooser = theirs
    if q.config.double_q:
        chooser = pair.network.judge(observation, memory, temperature=pair.temperature)[0]
    return best_value(q, pair.target, theirs, chooser, observation)


def following(
    q: Setup,
    pair: Pair,
    seen: Transition,
    online: tuple[AgentOutput, Memory],
    theirs: tuple[AgentOutput, Memory],
) -> Float[Array, "W M"]:
    """Return the value of what followed each step of a window that both networks have been unrolled along."""
    value = jax.vmap(lambda *now: best_value(q, pair.target, *now))(theirs[0], online[0], seen.observation)
    memories = online[1], theirs[1]
    if seen.left is not None:
        memories = jax.vmap(restarted, (None, 0, 0))((q.fresh, q.fresh), memories, seen.left)

    def anew(at: Int[Array, " K"]) -> Float[Array, "K M"]:
        ends = jax.tree.map(lambda leaf: leaf[at], (seen.next_observation, *memories))
        return jax.vmap(lambda *end: bootstrap(q, pair, *end))(*ends)

    return next_values(value, seen.truncated, q.env.shortest_truncated, anew)


def window_loss(
    q: Setup, pair: Pair, gamma: Float[Array, ""] | float, rewards: RewardNorm, heard: Transition, looks: Looks
) -> tuple[Float[Array, ""], Metrics]:
    """Return the loss on one window [W, …] of one environment."""
    network, learned = pair.network, q.config.sequence_length
    seen = heard if network.teacher is None else as_told(heard)
    now = jax.tree.map(lambda leaf: leaf[:learned], seen)
    ends = window_ends(q, seen)
    online = jax.tree.map(lambda leaf: leaf[:learned], looks.online[0])
    if looks.theirs is None:
        after = jax.tree.map(lambda leaf: leaf[ends.at], seen.next_observation)
        future = jax.vmap(lambda after: bootstrap(q, pair, after, (), ()))(after)
    else:
        future = following(q, pair, seen, looks.online, looks.theirs)[ends.at]
    value = jax.vmap(lambda *now: q.parts.team_value(network, *now))(online, now.decision.action, now.observation)
    reward = team_or_own(q, rewards, seen)[:, : value.shape[-1]]
    error = value - jax.lax.stop_gradient(window_targets(q, reward, future, ends, gamma))
    real = now.observation.agent_mask if q.parts.own_values else jnp.ones(error.shape, bool)
    td = jnp.where(real, huber(error, HUBER_DELTA), 0.0).sum() / jnp.maximum(real.sum(), 1)
    auxiliary = {}
    if looks.pupil is not None:
        teacher, online = online, looks.pupil
        available = q.actions.mask(now.observation.action_mask)
        taught = jax.vmap(lesson)(online.head, teacher.head, available, now.observation.agent_mask)
        auxiliary["loss_lesson"] = taught.mean()
    auxiliary |= q.parts.auxiliary(online, now.observation)
    metrics = {"loss_td": td, "value": value.mean(), **auxiliary}
    return td + sum(auxiliary.values(), jnp.zeros(())), metrics


def team_or_own(q: Setup, rewards: RewardNorm, seen: Transition) -> Float[Array, "W N"]:
    """Return the normalised rewards to learn from: the team's for everyone, or each agent's own."""
    return rewards.normalise(
        share_reward(seen, q.shares_reward), lives=q.parts.own_values and seen.left is not None
    )


class Ends(NamedTuple):
    """Where the targets of a window's learned steps end."""

    weight: Float[Array, "n W #M"]
    """Which of the n steps from each on belong to its target."""
    over: Bool[Array, "L #M"]
    """Whether nothing follows the target's last step: the task, or an agent's life, has ended."""
    at: Int[Array, " L"]
    """The step after which the target bootstraps, unless it is over."""


def window_ends(q: Setup, seen: Transition) -> Ends:
    """Return the ends of each learned step's target: one for the team, or one for each agent's life."""
    learned = q.config.sequence_length
    over = seen.terminated[:, None]
    if q.parts.own_values and seen.left is not None:
        over |= seen.left
    weight, last = n_step_window(over | seen.truncated[:, None], q.config.n_step)
    over = jnp.take_along_axis(over, last, axis=0, mode="clip")
    return Ends(weight, over[:learned], last[:learned].max(-1))  # a life that ends sooner needs no value


def window_targets(
    q: Setup, reward: Float[Array, "W M"], future: Float[Array, "L M"], ends: Ends, gamma: Float[Array, ""] | float
) -> Float[Array, "L M"]:
    """Return n rewards and then the value that followed; fewer where the episode, or a life of its own, ends."""
    learned, n = q.config.sequence_length, q.config.n_step
    earned = sum(gamma**k * ends.weight[k, :learned] * reward[k : k + learned] for k in range(n))
    length = ends.at - jnp.arange(learned) + 1
    return earned + gamma ** length[:, None] * ~ends.over * future


def loss(
    q: Setup, network: Network, learner: LearnerState, rewards: RewardNorm, batch: Experience, keys: Array
) -> tuple[Float[Array, ""], Metrics]:
    """Return the mean over windows [W, B, …]."""
    level = q.explorer.level(learner.exploration, learner.env_steps)
    pair = Pair(network, learner.target, level.temperature)
    one = partial(window_loss, q, pair, learner.hyper.gamma, rewards)
    losses = jax.vmap(one, 1)(batch.transition, look(q, pair, batch, keys))
    return jax.tree.map(lambda values: values.mean(0), losses)
