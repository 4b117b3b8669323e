"""Proximal policy optimisation of a team that shares its weights (Schulman et al. 2017; Yu et al. 2022).

Top to bottom: how agents act, targets, the loss, one update. MAPPO, IPPO and CommNet pass the view of their critic.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, Key

from gacrl.algorithms.actions import ActionSet
from gacrl.algorithms.augmentation import play, require_no_memory_in_symmetric_play, turn_experience
from gacrl.algorithms.contract import Algorithm
from gacrl.algorithms.distributions import Distribution, distribution, explores
from gacrl.algorithms.exploration import Exploration, Level, progress_between
from gacrl.algorithms.objectives import (
    ValueNorm,
    clipped_surrogate,
    follow_returns,
    huber,
    no_returns,
)
from gacrl.algorithms.returns import generalised_advantages, n_step_returns, next_values
from gacrl.algorithms.shared import clipped_adam, mean_real, share_reward, sum_over_devices
from gacrl.config.algorithms import NetworkConfig, PpoConfig
from gacrl.config.checks import require
from gacrl.config.kinds import EXPLORATION, resolve
from gacrl.config.run import TrainingConfig
from gacrl.envs.environment import Environment
from gacrl.networks.agent import AgentNetwork, matched, unroll
from gacrl.networks.critic import Critic, View
from gacrl.networks.layers import redrawn
from gacrl.networks.memory import beginnings, restarted
from gacrl.types import Decision, Memory, Metrics, Observation, Policy, PRNGKey, Rollout, Transition


class Network(eqx.Module):
    """What is learned; actor and critic share nothing."""

    actor: AgentNetwork
    critic: Critic


class PpoMemory(NamedTuple):
    """What actor and critic carry, and what exploration settled; () for a feed-forward network without a rule."""

    actor: Memory
    critic: Memory
    exploration: Any = ()


class Hyper(NamedTuple):
    """The numbers that a sweep can vary."""

    learning_rate: Float[Array, ""] | float
    learning_rate_end: Float[Array, ""] | float
    ent_coef: Float[Array, ""] | float
    ent_coef_end: Float[Array, ""] | float
    gamma: Float[Array, ""] | float
    gae_lambda: Float[Array, ""] | float
    clip_eps: Float[Array, ""] | float
    vf_coef: Float[Array, ""] | float
    planned_updates: Float[Array, ""] | float
    """Over which learning rate and entropy weight move; they stay at their end after it."""


class LearnerState(NamedTuple):
    """What PPO carries from update to update."""

    network: Network
    optimizer: optax.OptState
    norm: ValueNorm
    updates: Int[Array, ""]
    hyper: Hyper
    exploration: Any = ()


class Sample(NamedTuple):
    """Segments of a rollout to learn from, [L, B, …]: L steps that follow each other, B of them."""

    observation: Observation
    first: Bool[Array, "L B ..."]
    """Before which steps memories begin anew; [L, B, N] where lives end inside episodes."""
    action: Int[Array, "L B N"] | Float[Array, "L B N A"]
    key: Key[Array, "L B"]
    """What the agents drew with: the loss draws the same again, so that the first ratio is 1."""
    log_prob: Float[Array, "L B N"]
    advantage: Float[Array, "L B N"]
    target: Float[Array, "L B N"]
    """Of the critic, in normalised units."""
    epsilon: Float[Array, "L B"] | None = None
    """Share of random actions among those taken; None for none."""


@dataclass(frozen=True)
class Setup:
    """What is settled before anything is learned: constants of every function below."""

    config: PpoConfig
    env: Environment
    distribution: Distribution
    settings: NetworkConfig
    view: View
    explorer: Exploration
    adam: optax.GradientTransformation
    steps_per_update: int

    @property
    def actions(self) -> ActionSet:
        return self.distribution.actions


def make(
    config: PpoConfig, env: Environment, training: TrainingConfig, progress: str | None, view: View
) -> Algorithm:
    """Make PPO for this task's shapes, with the critic's view. progress: the measure that exploration may follow.

    Raises ConfigError for settings that continuous actions do not go with.
    """
    family = distribution(env)
    _require_fit(config, env)
    explore: Callable[..., Exploration] = resolve(EXPLORATION[config.exploration])
    per_update = training.num_envs * training.num_steps
    p = Setup(
        config=config,
        env=env,
        distribution=family,
        settings=matched(env, config.network, family.actions.size),
        view=view,
        explorer=explore(config, training.env_steps, progress),
        adam=clipped_adam(config.max_grad_norm, eps=1e-5),
        steps_per_update=per_update,
    )
    require_no_memory_in_symmetric_play(config, env, initial_memory(p, env.num_agents))
    return Algorithm(
        init=partial(init, p),
        initial_memory=partial(initial_memory, p),
        policy=partial(policy, p),
        update=partial(update, p),
        hyper=Hyper(
            learning_rate=config.learning_rate,
            learning_rate_end=config.learning_rate_end,
            ent_coef=config.ent_coef,
            ent_coef_end=config.ent_coef_end,
            gamma=config.gamma,
            gae_lambda=config.gae_lambda,
            clip_eps=config.clip_eps,
            vf_coef=config.vf_coef,
            planned_updates=max(1.0, training.env_steps / per_update),
        ),
        acting=lambda learner: learner._replace(optimizer=()),
        network=None if config.symmetric_play or env.continuous_actions else lambda learner: learner.network.actor,
        draws=True,
        parameters=lambda learner: learner.network,
        learned=lambda learner: learner._replace(optimizer=(), updates=(), hyper=(), exploration=()),
        splits_envs=True,
    )


def _require_fit(config: PpoConfig, env: Environment) -> None:
    """Raises ConfigError for what only a choice among actions has."""
    if env.continuous_actions:
        require(
            config.exploration == "none",
            f"algorithm.exploration {config.exploration} makes actions random, and continuous ones are drawn already: "
            "leave it at none",
        )
        require(
            not config.symmetric_play,
            "algorithm.symmetric_play takes the mean of choices, and these actions are continuous: leave it off",
        )


def networks(p: Setup, key: PRNGKey) -> Network:
    """Make actor and critic, orthogonal."""
    actor_key, critic_key = jax.random.split(key)
    gain = 2**0.5
    return Network(
        AgentNetwork(p.env, p.settings, p.actions.size, actor_key, gain, head_gain=0.01),
        Critic(p.env, p.settings, p.view, critic_key, gain),
    )


def init(p: Setup, key: PRNGKey, hyper: Hyper) -> LearnerState:
    """Make a learner that has learned nothing."""
    network = redrawn(networks(p, key), key)
    return LearnerState(
        network=network,
        optimizer=p.adam.init(network),  # pyright: ignore[reportArgumentType] a module is a pytree
        norm=no_returns(),
        updates=jnp.zeros((), jnp.int32),
        hyper=jax.tree.map(lambda number: jnp.asarray(number, float), hyper),
        exploration=p.explorer.init(),
    )


def initial_memory(p: Setup, num_agents: int) -> Memory:
    """Return the policy's memory at an episode's start; () where there is none."""
    network = eqx.filter_eval_shape(partial(networks, p), jax.random.key(0))
    memories = network.actor.initial_memory(num_agents), network.critic.initial_memory(num_agents)
    memory = PpoMemory(*memories, p.explorer.initial_memory)
    return memory if jax.tree.leaves(memory) else ()


def split_memory(memory: Memory) -> PpoMemory:
    """Return a policy's memory as actor's and critic's."""
    return memory if isinstance(memory, PpoMemory) else PpoMemory((), ())


def level_of(p: Setup, learner: LearnerState) -> Level:
    """Return how much is explored until the next update."""
    env_steps = learner.updates * p.steps_per_update if p.explorer.moves else learner.updates
    return p.explorer.level(learner.exploration, env_steps)


def policy(p: Setup, learner: LearnerState, explore: bool) -> Policy:
    """Sample from π, among random actions where the rule of exploration has some; or act greedily."""
    level = level_of(p, learner)

    def act(memory: Memory, observation: Observation, key: PRNGKey) -> tuple[Decision, Memory]:
        actor_memory, critic_memory, mode = split_memory(memory)
        talk_key, choice_key = jax.random.split(key)
        actor, temperature, extras = learner.network.actor, level.temperature, {}
        if explore:
            output, actor_memory = actor(observation, actor_memory, talk_key, temperature)
        else:
            symmetric = p.config.symmetric_play
            output, actor_memory = play(p.env, symmetric, actor, observation, actor_memory, temperature)
        pi = p.distribution.of(output.head, p.actions.mask(observation.action_mask))
        if explore:
            settles = jax.tree.leaves(mode)  # where nothing does, nothing is drawn for it
            mode_key = jax.random.fold_in(choice_key, 1) if settles else choice_key
            mode, epsilon = p.explorer.begin(mode, mode_key, level.epsilon)
            pi = p.distribution.mixed(pi, epsilon)
            extras = {"epsilon": jnp.asarray(epsilon)} if explores(epsilon) else {}
        choice = p.distribution.sample(pi, choice_key) if explore else p.distribution.mode(pi)
        value, critic_memory = learner.network.critic(observation, critic_memory)
        extras |= {
            "value": learner.norm.denormalise(value),
            "choice": choice,
            "log_prob": p.distribution.log_prob(pi, choice),
            "key": talk_key,
            "mode": mode,
        }
        decision = Decision(p.actions.act(choice), output.messages, output.adjacency, extras)
        return decision, PpoMemory(actor_memory, critic_memory, mode) if memory else ()

    return act


def targets(
    p: Setup, learner: LearnerState, steps: Transition, memory: PpoMemory
) -> tuple[Float[Array, "T E N"], Float[Array, "T E N"]]:
    """Return advantages and returns of every agent, in the units of the reward."""
    critic, value = learner.network.critic, steps.decision.extras["value"]

    def after(steps: Transition, memory: Memory, value: Float[Array, "T N"]) -> Float[Array, "T N"]:
        memories = ()
        if critic.memory is not None:
            memories = critic.unroll(steps.observation, beginnings(steps.first, steps.left), memory)[1]
            if steps.left is not None:
                fresh = critic.initial_memory(p.env.num_agents)
                memories = jax.vmap(restarted, (None, 0, 0))(fresh, memories, steps.left)

        def anew(at: Int[Array, " K"]) -> Float[Array, "K N"]:
            seen, before = jax.tree.map(lambda leaf: leaf[at], (steps.next_observation, memories))
            return learner.norm.denormalise(jax.vmap(lambda *end: critic(*end)[0])(seen, before))

        return next_values(value, steps.truncated, p.env.shortest_truncated, anew)

    next_value = jax.vmap(after, (1, 0, 1), 1)(steps, memory.critic, value)
    reward = share_reward(steps, p.config.reward == "team")
    ends = (steps.terminated[..., None], steps.truncated[..., None])
    terminated, truncated = (jnp.broadcast_to(end, reward.shape) for end in ends)
    if steps.left is not None:
        terminated |= steps.left
    gamma = learner.hyper.gamma
    if p.config.n_step:
        returns = n_step_returns(reward, next_value, terminated, truncated, gamma, p.config.n_step)
        return returns - value, returns
    advantage = generalised_advantages(
        reward, value, next_value, terminated, truncated, gamma, learner.hyper.gae_lambda
    )
    return advantage, advantage + value


def loss(
    network: Network,
    sample: Sample,
    memory: PpoMemory,
    hyper: Hyper,
    ent_coef: Float[Array, ""],
    huber_delta: float,
    family: Distribution,
    count: Int[Array, ""] | None = None,
    temperature: Float[Array, ""] | float = 1.0,
) -> tuple[Float[Array, ""], Metrics]:
    """Sum policy, critic and entropy terms on segments, and the messages' own; means over the real agents.

    memory: what actor and critic carried before each segment, [B, …]. count: as in `mean_real`.
    """

    def one(observation: Observation, first: Array, key: Array, memory: PpoMemory):
        acted, _ = unroll(network.actor, observation, first, memory.actor, key, temperature)
        own = {} if acted.message_loss is None else {"loss_messages": acted.message_loss}
        return acted.head, network.critic.unroll(observation, first, memory.critic)[0], own

    head, value, own = jax.vmap(one, (1, 1, 1, 0), 1)(sample.observation, sample.first, sample.key, memory)
    pi = family.of(head, sample.observation.action_mask)
    shares = None if sample.epsilon is None else sample.epsilon[..., None]  # of all agents of an environment
    log_prob = family.log_prob(family.mixed(pi, shares), sample.action)
    real = sample.observation.agent_mask
    parts = {
        "loss_policy": clipped_surrogate(log_prob, sample.log_prob, sample.advantage, hyper.clip_eps),
        "loss_critic": huber(value - sample.target, huber_delta),
        "entropy": family.entropy(pi),
        "ratio_clipped": (jnp.abs(jnp.exp(log_prob - sample.log_prob) - 1) > hyper.clip_eps) * 1.0,
        "kl": sample.log_prob - log_prob,
        **own,
    }
    parts = {name: mean_real(values, real, count) for name, values in parts.items()}
    total = parts["loss_policy"] + hyper.vf_coef * parts["loss_critic"] - ent_coef * parts["entropy"]
    return total + parts["loss_messages"] if own else total, parts


def normalised(advantage: Float[Array, "T E N"], real: Bool[Array, "T E N"]) -> Float[Array, "T E N"]:
    """Return advantages in standard deviations of the rollout, around its mean."""
    centre = mean_real(advantage, real)
    spread = jnp.sqrt(mean_real(jnp.square(advantage - centre), real))
    return (advantage - centre) / (spread + 1e-8)


def gradients_on(p: Setup, whole: tuple[Any, ...], rows: Int[Array, " rows"]) -> tuple[Network, Metrics]:
    """Differentiate these rows' part of the loss; count: the real agents of the whole minibatch."""
    network, sample, memory, hyper, ent_coef, count, temperature = whole
    part = jax.tree.map(lambda leaf: leaf[:, rows], sample)
    remembered = jax.tree.map(lambda leaf: leaf[rows], memory)
    gradient = jax.grad(loss, has_aux=True)
    coefficients = hyper, ent_coef, p.config.huber_delta
    return gradient(network, part, remembered, *coefficients, p.distribution, count, temperature)


def update(p: Setup, learner: LearnerState, rollout: Rollout, key: PRNGKey) -> tuple[LearnerState, Metrics]:
    """Compute targets, then take epochs of gradient steps on shuffled minibatches of a rollout [T, E, …]."""
    turn_key, shuffle_key = jax.random.split(key)
    memory = split_memory(rollout.first_memory)._replace(exploration=())
    steps = chosen(p, rollout.transitions)
    advantage, returns = targets(p, learner, steps, memory)
    if p.config.augment:
        # Advantages, returns and the probability of the choice do not turn; what is remembered cannot.
        steps = turn_experience(p.env, p.actions, steps, turn_key)
        memory = jax.tree.map(jnp.zeros_like, memory)
    real = steps.observation.agent_mask
    norm = follow_returns(learner.norm, returns, real) if p.config.value_norm else learner.norm
    sample = sample_of(steps, normalised(advantage, real), norm.normalise(returns))
    if not jax.tree.leaves(memory):  # nothing holds the steps together: each is a segment
        sample = jax.tree.map(lambda leaf: leaf.reshape(1, -1, *leaf.shape[2:]), sample)
    hyper, fraction = learner.hyper, learner.updates / learner.hyper.planned_updates
    learning_rate = progress_between(hyper.learning_rate, hyper.learning_rate_end, fraction)
    ent_coef = progress_between(hyper.ent_coef, hyper.ent_coef_end, fraction)
    temperature = level_of(p, learner).temperature

    def gradient_step(loop: tuple[Network, Any], step: tuple[Int[Array, " rows"], Int[Array, ""]]):
        (network, optimizer), (rows, count) = loop, step
        whole = (network, sample, memory, hyper, ent_coef, count, temperature)
        gradients, metrics = sum_over_devices(partial(gradients_on, p), whole, rows)
        directions, optimizer = p.adam.update(gradients, optimizer)
        network = jax.tree.map(lambda w, d: w - learning_rate * d, network, directions)
        return (network, optimizer), metrics

    rows = minibatches(shuffle_key, sample.first.shape[1], p.config.update_epochs, p.config.num_minibatches)
    counts = jax.vmap(lambda rows: sample.observation.agent_mask[:, rows].sum())(rows)
    start = learner.network, learner.optimizer
    (network, optimizer), metrics = jax.lax.scan(gradient_step, start, (rows, counts))
    metrics = {name: values.mean() for name, values in metrics.items()}
    metrics |= {"learning_rate": learning_rate, "value_error": mean_real(jnp.abs(advantage), real)}
    exploration = p.explorer.follow(learner.exploration, steps)
    learner = LearnerState(network, optimizer, norm, learner.updates + 1, hyper, exploration)
    return learner, metrics


def chosen(p: Setup, steps: Transition) -> Transition:
    """Return the steps with choices for actions, and with the masks of choices."""
    available = p.actions.mask(steps.observation.action_mask)
    return steps._replace(
        observation=steps.observation._replace(action_mask=available),
        decision=steps.decision._replace(action=steps.decision.extras["choice"]),
    )


def sample_of(steps: Transition, advantage: Float[Array, "T E N"], target: Float[Array, "T E N"]) -> Sample:
    """Return what is learned from: a rollout's choices, and what came of them."""
    extras, first = steps.decision.extras, steps.first
    if steps.left is not None:
        first = jax.vmap(beginnings, 1, 1)(steps.first, steps.left)
    return Sample(
        observation=steps.observation,
        first=first,
        action=steps.decision.action,  # what was drawn, by now
        key=extras["key"],
        log_prob=extras["log_prob"],
        advantage=advantage,
        target=target,
        epsilon=extras.get("epsilon"),
    )


def minibatches(key: PRNGKey, size: int, epochs: int, count: int) -> Int[Array, "steps rows"]:
    """Shuffle rows, anew for each epoch; what does not fill a minibatch is left out of that epoch."""
    count = min(count, size)
    rows = size // count
    shuffled = jax.vmap(lambda key: permutation(key, size))(jax.random.split(key, epochs))
    return shuffled[:, : rows * count].reshape(epochs * count, rows)


def permutation(key: PRNGKey, size: int) -> Int[Array, " size"]:
    """Return 0 to size − 1 in random order.

    Random numbers are sorted that hold the rows in their low bits: a CPU takes a fifth or less of the time that
    `jax.random.permutation` takes for pairs. Where the random bits are equal, a random mask of the rows decides.
    """
    width = (size - 1).bit_length()
    if width > 16:  # too few random bits are left
        return jax.random.permutation(key, size)
    bits, mask = jax.random.split(key)
    low = jnp.uint32(2**width - 1)
    mask = jax.random.bits(mask) & low
    numbers = jax.random.bits(bits, (size,)) & ~low | (jnp.arange(size, dtype=jnp.uint32) ^ mask)
    return ((jnp.sort(numbers) & low) ^ mask).astype(jnp.int32)
