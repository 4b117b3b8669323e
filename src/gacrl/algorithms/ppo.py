"""Proximal policy optimisation of a team that shares its weights (Schulman et al. 2017; Yu et al. 2022).

Top to bottom: how agents act, targets, the loss, one update. MAPPO and IPPO pass the view of their critic.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, Key

from gacrl.algorithms.actions import choices
from gacrl.algorithms.augmentation import play, turn_experience
from gacrl.algorithms.contract import Algorithm
from gacrl.algorithms.exploration import progress_between
from gacrl.algorithms.objectives import ValueNorm, clipped_surrogate, follow_returns, huber, no_returns
from gacrl.algorithms.returns import generalised_advantages, n_step_returns, next_values
from gacrl.algorithms.shared import clipped_adam, mean_real, share_reward, sum_over_devices, taken
from gacrl.config.algorithms import PpoConfig
from gacrl.config.run import TrainingConfig
from gacrl.envs.environment import Environment
from gacrl.networks.agent import AgentNetwork, matched, unroll
from gacrl.networks.critic import Critic, View
from gacrl.types import Channel, Decision, Memory, Metrics, Observation, Policy, PRNGKey, Rollout, Transition


class Network(eqx.Module):
    actor: AgentNetwork
    critic: Critic


class PpoMemory(NamedTuple):
    """What actor and critic carry; () for a feed-forward network."""

    actor: Memory
    critic: Memory


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
    network: Network
    optimizer: optax.OptState
    norm: ValueNorm
    updates: Int[Array, ""]
    hyper: Hyper


class Sample(NamedTuple):
    """Segments of a rollout to learn from, [L, B, …]: L steps that follow each other, B of them."""

    observation: Observation
    first: Bool[Array, "L B"]
    action: Int[Array, "L B N"]
    key: Key[Array, "L B"]
    """What the agents drew with: the loss draws the same again, so that the first ratio is 1."""
    log_prob: Float[Array, "L B N"]
    advantage: Float[Array, "L B N"]
    target: Float[Array, "L B N"]
    """Of the critic, in normalised units."""


def log_policy(logits: Float[Array, "*b A"], action_mask: Bool[Array, "*b A"]) -> Float[Array, "*b A"]:
    """log π; −∞ for actions that are not available."""
    return jax.nn.log_softmax(jnp.where(action_mask, logits, -jnp.inf))


def entropy(log_probs: Float[Array, "*b A"]) -> Float[Array, "*b"]:
    """Of categorical distributions, in nats; actions with probability 0 count nothing."""
    probs = jnp.exp(log_probs)
    return -(probs * jnp.where(probs > 0, log_probs, 0.0)).sum(-1)


def loss(
    network: Network,
    sample: Sample,
    memory: PpoMemory,
    hyper: Hyper,
    ent_coef: Float[Array, ""],
    huber_delta: float,
    count: Int[Array, ""] | None = None,
) -> tuple[Float[Array, ""], Metrics]:
    """Policy, critic and entropy terms on segments; means over the real agents.

    memory: what actor and critic carried before each segment, [B, …]. count: as in `mean_real`.
    """

    def one(observation: Observation, first: Array, key: Array, memory: PpoMemory):
        acted, _ = unroll(network.actor, observation, first, memory.actor, key)
        return acted.head, network.critic.unroll(observation, first, memory.critic)[0]

    logits, value = jax.vmap(one, (1, 1, 1, 0), 1)(sample.observation, sample.first, sample.key, memory)
    log_probs = log_policy(logits, sample.observation.action_mask)
    log_prob = taken(log_probs, sample.action)
    real = sample.observation.agent_mask
    parts = {
        "loss_policy": clipped_surrogate(log_prob, sample.log_prob, sample.advantage, hyper.clip_eps),
        "loss_critic": huber(value - sample.target, huber_delta),
        "entropy": entropy(log_probs),
        "ratio_clipped": (jnp.abs(jnp.exp(log_prob - sample.log_prob) - 1) > hyper.clip_eps) * 1.0,
        "kl": sample.log_prob - log_prob,
    }
    parts = {name: mean_real(values, real, count) for name, values in parts.items()}
    total = parts["loss_policy"] + hyper.vf_coef * parts["loss_critic"] - ent_coef * parts["entropy"]
    return total, parts


def make(config: PpoConfig, env: Environment, training: TrainingConfig, view: View) -> Algorithm:
    """PPO for this task's shapes, with the critic's view."""
    actions = choices(env)
    adam = clipped_adam(config.max_grad_norm, eps=1e-5)
    settings = matched(env, config.network, actions.size)
    per_update = training.num_envs * training.num_steps
    hyper = Hyper(
        learning_rate=config.learning_rate,
        learning_rate_end=config.learning_rate_end,
        ent_coef=config.ent_coef,
        ent_coef_end=config.ent_coef_end,
        gamma=config.gamma,
        gae_lambda=config.gae_lambda,
        clip_eps=config.clip_eps,
        vf_coef=config.vf_coef,
        planned_updates=max(1.0, training.env_steps / per_update),
    )

    def networks(key: PRNGKey) -> Network:
        actor_key, critic_key = jax.random.split(key)
        gain = 2**0.5
        return Network(
            AgentNetwork(env, settings, actions.size, actor_key, gain, head_gain=0.01),
            Critic(env, settings, view, critic_key, gain),
        )

    def init(key: PRNGKey, hyper: Hyper) -> LearnerState:
        network = networks(key)
        return LearnerState(
            network=network,
            optimizer=adam.init(network),  # pyright: ignore[reportArgumentType] a module is a pytree
            norm=no_returns(),
            updates=jnp.zeros((), jnp.int32),
            hyper=jax.tree.map(lambda number: jnp.asarray(number, float), hyper),
        )

    def initial_memory(num_agents: int) -> Memory:
        network = eqx.filter_eval_shape(networks, jax.random.key(0))
        memory = PpoMemory(network.actor.initial_memory(num_agents), network.critic.initial_memory(num_agents))
        return memory if jax.tree.leaves(memory) else ()

    def policy(learner: LearnerState, explore: bool) -> Policy:
        def act(
            memory: Memory, observation: Observation, key: PRNGKey, channel: Channel
        ) -> tuple[Decision, Memory]:
            actor_memory, critic_memory = split_memory(memory)
            talk_key, choice_key = jax.random.split(key)
            actor = learner.network.actor
            if explore:
                output, actor_memory = actor(observation, actor_memory, talk_key, channel)
            else:
                output, actor_memory = play(env, config.symmetric_play, actor, observation, actor_memory, channel)
            log_probs = log_policy(output.head, actions.mask(observation.action_mask))
            choice = jax.random.categorical(choice_key, log_probs) if explore else log_probs.argmax(-1)
            value, critic_memory = learner.network.critic(observation, critic_memory)
            extras = {
                "value": learner.norm.denormalise(value),
                "choice": choice,
                "log_prob": taken(log_probs, choice),
                "key": talk_key,
            }
            decision = Decision(actions.act(choice), output.message, output.adjacency, extras)
            return decision, PpoMemory(actor_memory, critic_memory) if memory else ()

        return act

    def targets(
        learner: LearnerState, steps: Transition, memory: PpoMemory
    ) -> tuple[Float[Array, "T E N"], Float[Array, "T E N"]]:
        """Advantages and returns of every agent, in the units of the reward."""
        critic, value = learner.network.critic, steps.decision.extras["value"]

        def after(steps: Transition, memory: Memory, value: Float[Array, "T N"]) -> Float[Array, "T N"]:
            memories = () if critic.memory is None else critic.unroll(steps.observation, steps.first, memory)[1]

            def anew(at: Int[Array, " K"]) -> Float[Array, "K N"]:
                seen, before = jax.tree.map(lambda leaf: leaf[at], (steps.next_observation, memories))
                return learner.norm.denormalise(jax.vmap(lambda *end: critic(*end)[0])(seen, before))

            return next_values(value, steps.truncated, env.max_cycles, anew)

        next_value = jax.vmap(after, (1, 0, 1), 1)(steps, memory.critic, value)
        reward = share_reward(steps.reward, steps.observation.agent_mask, config.reward == "team")
        ends = (steps.terminated[..., None], steps.truncated[..., None])
        terminated, truncated = (jnp.broadcast_to(end, reward.shape) for end in ends)
        gamma = learner.hyper.gamma
        if config.n_step:
            returns = n_step_returns(reward, next_value, terminated, truncated, gamma, config.n_step)
            return returns - value, returns
        advantage = generalised_advantages(
            reward, value, next_value, terminated, truncated, gamma, learner.hyper.gae_lambda
        )
        return advantage, advantage + value

    def update(learner: LearnerState, rollout: Rollout, key: PRNGKey) -> tuple[LearnerState, Metrics]:
        turn_key, shuffle_key = jax.random.split(key)
        memory = split_memory(rollout.first_memory)
        steps = rollout.transitions
        steps = steps._replace(
            observation=steps.observation._replace(action_mask=actions.mask(steps.observation.action_mask)),
            decision=steps.decision._replace(action=steps.decision.extras["choice"]),
        )
        advantage, returns = targets(learner, steps, memory)
        if config.augment:
            # Advantages, returns and the probability of the choice do not turn; what is remembered cannot.
            steps = turn_experience(env, steps, turn_key)
            memory = jax.tree.map(jnp.zeros_like, memory)
        real = steps.observation.agent_mask
        norm = follow_returns(learner.norm, returns, real) if config.value_norm else learner.norm
        centre = mean_real(advantage, real)
        spread = jnp.sqrt(mean_real(jnp.square(advantage - centre), real))
        sample = Sample(
            observation=steps.observation,
            first=steps.first,
            action=steps.decision.action,  # pyright: ignore[reportArgumentType] they are indices now
            key=steps.decision.extras["key"],
            log_prob=steps.decision.extras["log_prob"],
            advantage=(advantage - centre) / (spread + 1e-8),
            target=norm.normalise(returns),
        )
        if not jax.tree.leaves(memory):  # nothing holds the steps together: each is a segment
            sample = jax.tree.map(lambda leaf: leaf.reshape(1, -1, *leaf.shape[2:]), sample)
        hyper, fraction = learner.hyper, learner.updates / learner.hyper.planned_updates
        learning_rate = progress_between(hyper.learning_rate, hyper.learning_rate_end, fraction)
        ent_coef = progress_between(hyper.ent_coef, hyper.ent_coef_end, fraction)

        def gradients_on(whole: tuple[Any, ...], rows: Int[Array, " rows"]) -> tuple[Network, Metrics]:
            """Of these rows' part of the loss; count: the real agents of the whole minibatch."""
            network, sample, memory, hyper, ent_coef, count = whole
            part = jax.tree.map(lambda leaf: leaf[:, rows], sample)
            remembered = jax.tree.map(lambda leaf: leaf[rows], memory)
            gradient = jax.grad(loss, has_aux=True)
            return gradient(network, part, remembered, hyper, ent_coef, config.huber_delta, count)

        def gradient_step(loop: tuple[Network, Any], step: tuple[Int[Array, " rows"], Int[Array, ""]]):
            (network, optimizer), (rows, count) = loop, step
            whole = (network, sample, memory, hyper, ent_coef, count)
            gradients, metrics = sum_over_devices(gradients_on, whole, rows)
            directions, optimizer = adam.update(gradients, optimizer)
            network = jax.tree.map(lambda w, d: w - learning_rate * d, network, directions)
            return (network, optimizer), metrics

        rows = minibatches(shuffle_key, sample.first.shape[1], config.update_epochs, config.num_minibatches)
        counts = jax.vmap(lambda rows: sample.observation.agent_mask[:, rows].sum())(rows)
        (network, optimizer), metrics = jax.lax.scan(
            gradient_step, (learner.network, learner.optimizer), (rows, counts)
        )
        metrics = {name: values.mean() for name, values in metrics.items()}
        metrics |= {"learning_rate": learning_rate, "value_error": mean_real(jnp.abs(advantage), real)}
        return LearnerState(network, optimizer, norm, learner.updates + 1, hyper), metrics

    return Algorithm(init, initial_memory, policy, update, hyper)


def split_memory(memory: Memory) -> PpoMemory:
    """A policy's memory as actor's and critic's."""
    return memory if isinstance(memory, PpoMemory) else PpoMemory((), ())


def minibatches(key: PRNGKey, size: int, epochs: int, count: int) -> Int[Array, "steps rows"]:
    """Shuffled rows, anew for each epoch; what does not fill a minibatch is left out of that epoch."""
    count = min(count, size)
    rows = size // count
    shuffled = jax.vmap(lambda key: permutation(key, size))(jax.random.split(key, epochs))
    return shuffled[:, : rows * count].reshape(epochs * count, rows)


def permutation(key: PRNGKey, size: int) -> Int[Array, " size"]:
    """0 to size − 1 in random order.

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
