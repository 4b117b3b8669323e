"""Q-learning of a team from replay, shared by QMIX, VDN, IQL and GACRL: they pass what is theirs in `Parts`.

Top to bottom: what a learner passes, what is remembered, how agents act, the loss, one update. Double Q-learning
(van Hasselt et al. 2016), n-step targets, a target network that follows slowly. Messages are not
remembered but made anew by the network that is learning; of memories, the one at the start of a window is.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int

from gacrl.algorithms import replay as ring
from gacrl.algorithms.actions import choices
from gacrl.algorithms.augmentation import play, turn_experience
from gacrl.algorithms.contract import Algorithm
from gacrl.algorithms.exploration import Exploration, progress_between
from gacrl.algorithms.objectives import ValueNorm, follow_returns, huber, no_returns
from gacrl.algorithms.returns import n_step_window, next_values
from gacrl.algorithms.shared import clipped_adam, share_reward
from gacrl.config.algorithms import QLearningConfig
from gacrl.config.run import TrainingConfig
from gacrl.envs.environment import Environment
from gacrl.networks.agent import AgentNetwork, AgentOutput, unroll
from gacrl.types import Channel, Decision, Memory, Metrics, Observation, Policy, PRNGKey, Rollout, Transition

HUBER_DELTA = 10.0
"""Errors beyond this count linearly."""


class Network(eqx.Module):
    """What is learned: the agents' network, whose head gives a number for each action, and the team's part."""

    agent: AgentNetwork
    team: Any


TeamValue = Callable[[Network, AgentOutput, Int[Array, " N"], Observation], Float[Array, " M"]]
"""(network, its output, actions, observation) -> what is learned: the team's value, or each agent's."""


class Parts(NamedTuple):
    """What makes a learner out of this file."""

    networks: Callable[[PRNGKey], Network]
    team_value: TeamValue
    exploration: Exploration
    auxiliary: Callable[[AgentOutput], Metrics]
    """Further terms of the loss, weighted already, from what the network put out; {} for none."""


class Experience(NamedTuple):
    """What the replay remembers of a step of one environment."""

    transition: Transition
    memory: Memory
    """The network's, before the step."""


class ActMemory(NamedTuple):
    """The policy's memory: the network's, and what exploration settled at the start of the episode."""

    network: Memory
    exploration: Any


class Hyper(NamedTuple):
    """The numbers that a sweep can vary."""

    learning_rate: Float[Array, ""] | float
    learning_rate_end: Float[Array, ""] | float
    gamma: Float[Array, ""] | float
    target_step: Float[Array, ""] | float
    planned_steps: Float[Array, ""] | float
    """Environment steps over which the learning rate moves; it stays at its end after them."""


class LearnerState(NamedTuple):
    network: Network
    target: Network
    optimizer: optax.OptState
    replay: ring.Replay[Float[Array, "capacity E W"]]
    """Of experiences, each packed into one vector."""
    rewards: ValueNorm
    """Running moments of the reward."""
    exploration: Any
    env_steps: Int[Array, ""]
    hyper: Hyper


def epsilon_greedy(
    key: PRNGKey, values: Float[Array, "N A"], action_mask: Bool[Array, "N A"], epsilon: Float[Array, ""]
) -> Int[Array, " N"]:
    """The best available action, or with probability ε any available one."""
    explore_key, action_key = jax.random.split(key)
    anything = jax.random.categorical(action_key, jnp.where(action_mask, 0.0, -jnp.inf))
    exploring = jax.random.bernoulli(explore_key, epsilon, anything.shape)
    return jnp.where(exploring, anything, greedy(values, action_mask))


def greedy(values: Float[Array, "N A"], action_mask: Bool[Array, "N A"]) -> Int[Array, " N"]:
    """The best available action of each agent."""
    return jnp.where(action_mask, values, -jnp.inf).argmax(-1)


def make(config: QLearningConfig, env: Environment, training: TrainingConfig, parts: Parts) -> Algorithm:
    """The learner for this task's shapes."""
    actions = choices(env)
    adam = clipped_adam(config.max_grad_norm)
    num_envs, num_steps = training.num_envs, training.num_steps
    learned, window = config.sequence_length, config.sequence_length + config.n_step - 1
    rows = max(-(-config.replay_capacity // (num_envs * num_steps)), -(-window // num_steps)) * num_steps
    hyper = Hyper(
        learning_rate=config.learning_rate,
        learning_rate_end=config.learning_rate_end,
        gamma=config.gamma,
        target_step=config.target_step,
        planned_steps=training.env_steps,
    )
    shapes = eqx.filter_eval_shape(parts.networks, jax.random.key(0))
    nothing_remembered = shapes.agent.initial_memory(env.num_agents)
    forgetful = not jax.tree.leaves(nothing_remembered)

    def initial_memory(num_agents: int) -> Memory:
        memory = ActMemory(shapes.agent.initial_memory(num_agents), parts.exploration.initial_memory)
        return memory if jax.tree.leaves(memory) else ()

    def example() -> Experience:
        """A step's shapes."""
        state, observation = env.reset(jax.random.key(0))
        choice = jnp.zeros(env.num_agents, jnp.int32)
        after, false = env.step(state, actions.act(choice), jax.random.key(0))[1], jnp.zeros((), bool)
        step = Transition(observation, Decision(choice), after.reward, false, false, false, after.observation, {})
        return Experience(step, nothing_remembered)

    packed_size, unpack = ring.packing(example)

    def init(key: PRNGKey, hyper: Hyper) -> LearnerState:
        network = parts.networks(key)
        return LearnerState(
            network=network,
            target=network,
            optimizer=adam.init(network),  # pyright: ignore[reportArgumentType] a module is a pytree
            replay=ring.empty(jnp.zeros((num_envs, packed_size)), rows),
            rewards=no_returns(),
            exploration=parts.exploration.init(),
            env_steps=jnp.zeros((), jnp.int32),
            hyper=jax.tree.map(lambda number: jnp.asarray(number, float), hyper),
        )

    def policy(learner: LearnerState, explore: bool) -> Policy:
        network = learner.target if config.averaged and not explore else learner.network
        level = parts.exploration.level(learner.exploration, learner.env_steps)

        def act(
            memory: Memory, observation: Observation, key: PRNGKey, channel: Channel
        ) -> tuple[Decision, Memory]:
            remembered = memory if isinstance(memory, ActMemory) else ActMemory((), ())
            mode_key, talk_key, action_key = jax.random.split(key, 3)
            mode = remembered.exploration
            before, temperature = remembered.network, level.temperature
            if explore:
                output, after = network.agent(observation, before, talk_key, channel, temperature)
                mode, epsilon = parts.exploration.begin(mode, mode_key, level.epsilon)
                choice = epsilon_greedy(action_key, output.head, actions.mask(observation.action_mask), epsilon)
            else:
                output, after = play(
                    env, config.symmetric_play, network.agent, observation, before, channel, temperature
                )
                choice = greedy(output.head, actions.mask(observation.action_mask))
            best = greedy(output.head, actions.mask(observation.action_mask))
            value = parts.team_value(network, output, best, observation).mean()
            extras = {
                "value": jnp.broadcast_to(value, choice.shape),
                "choice": choice,
                "memory": before,
                "mode": mode,
            }
            decision = Decision(actions.act(choice), output.message, output.adjacency, extras)
            return decision, ActMemory(after, mode) if isinstance(memory, ActMemory) else ()

        return act

    def outputs(
        network: Network, steps: Transition, memory: Memory, key: PRNGKey | None, temperature: Array
    ) -> tuple[AgentOutput, Memory]:
        """Along a window: what is put out, and the memory after each step."""
        keys = None if key is None else jax.random.split(key, steps.first.shape[0])
        return unroll(network.agent, steps.observation, steps.first, memory, keys, temperature)

    def best_value(
        target: Network, theirs: AgentOutput, chooser: AgentOutput, observation: Observation
    ) -> Float[Array, " M"]:
        """The target network's value of the actions that are best: by the online network with double Q."""
        best = greedy((chooser if config.double_q else theirs).head, actions.mask(observation.action_mask))
        return parts.team_value(target, theirs, best, observation)

    def bootstrap(
        network: Network,
        target: Network,
        temperature: Array,
        observation: Observation,
        memory: Memory,
        target_memory: Memory,
    ) -> Float[Array, " M"]:
        """The same of an observation that is yet to be looked at."""
        theirs = target.agent(observation, target_memory, temperature=temperature)[0]
        chooser = network.agent(observation, memory, temperature=temperature)[0] if config.double_q else theirs
        return best_value(target, theirs, chooser, observation)

    def following(
        network: Network,
        target: Network,
        temperature: Array,
        seen: Transition,
        online: tuple[AgentOutput, Memory],
        theirs: tuple[AgentOutput, Memory],
    ) -> Float[Array, "W M"]:
        """The same of what followed each step of a window that both have been unrolled along."""
        value = jax.vmap(lambda *now: best_value(target, *now))(theirs[0], online[0], seen.observation)

        def anew(at: Int[Array, " K"]) -> Float[Array, "K M"]:
            ends = jax.tree.map(lambda leaf: leaf[at], (seen.next_observation, online[1], theirs[1]))
            return jax.vmap(lambda *end: bootstrap(network, target, temperature, *end))(*ends)

        return next_values(value, seen.truncated, env.max_cycles, anew)

    def one_window(
        network: Network, learner: LearnerState, rewards: ValueNorm, steps: Experience, key: PRNGKey
    ) -> tuple[Float[Array, ""], Metrics]:
        """The loss on one window [W, …] of one environment."""
        seen, target = steps.transition, learner.target
        memory = jax.tree.map(lambda leaf: leaf[0], steps.memory)
        if config.augment:  # what is remembered is not turned
            memory = jax.tree.map(jnp.zeros_like, memory)
        temperature = parts.exploration.level(learner.exploration, learner.env_steps).temperature
        now = jax.tree.map(lambda leaf: leaf[:learned], seen)
        weight, last = n_step_window(seen.terminated | seen.truncated, config.n_step)
        last = last[:learned]
        if forgetful:
            online, _ = outputs(network, now, (), key, temperature)
            after = jax.tree.map(lambda leaf: leaf[last], seen.next_observation)
            future = jax.vmap(lambda after: bootstrap(network, target, temperature, after, (), ()))(after)
        else:
            unrolled = outputs(network, seen, memory, key, temperature)
            theirs = outputs(target, seen, memory, None, temperature)
            future = following(network, target, temperature, seen, unrolled, theirs)[last]
            online = jax.tree.map(lambda leaf: leaf[:learned], unrolled[0])
        value = jax.vmap(lambda *now: parts.team_value(network, *now))(
            online, now.decision.action, now.observation
        )
        shared = config.reward == "team" or value.shape[-1] == 1  # a value of the team is learned from its reward
        reward = share_reward(seen.reward, seen.observation.agent_mask, shared)
        reward = rewards.normalise(reward)[:, : value.shape[-1]]
        gamma = learner.hyper.gamma
        earned = sum(gamma**k * weight[k, :learned, None] * reward[k : k + learned] for k in range(config.n_step))
        length = last - jnp.arange(learned) + 1
        discount = gamma ** length[:, None] * ~seen.terminated[last][:, None]
        error = value - jax.lax.stop_gradient(earned + discount * future)
        real = now.observation.agent_mask if error.shape[-1] > 1 else jnp.ones(error.shape, bool)
        td = jnp.where(real, huber(error, HUBER_DELTA), 0.0).sum() / jnp.maximum(real.sum(), 1)
        auxiliary = parts.auxiliary(online)
        metrics = {"loss_td": td, "value": value.mean(), **auxiliary}
        return td + sum(auxiliary.values(), jnp.zeros(())), metrics

    def loss(
        network: Network, learner: LearnerState, rewards: ValueNorm, batch: Experience, keys: Array
    ) -> tuple[Float[Array, ""], Metrics]:
        """The mean over windows [W, B, …]."""
        losses = jax.vmap(lambda steps, key: one_window(network, learner, rewards, steps, key), (1, 0))(
            batch, keys
        )
        return jax.tree.map(lambda values: values.mean(0), losses)

    def update(learner: LearnerState, rollout: Rollout, key: PRNGKey) -> tuple[LearnerState, Metrics]:
        """Remember a rollout, then take the configured gradient steps."""
        steps = rollout.transitions
        kept = steps._replace(decision=Decision(steps.decision.extras["choice"]), info={})
        block = Experience(kept, steps.decision.extras["memory"])
        replay = ring.add_block(learner.replay, jax.vmap(jax.vmap(ring.pack))(block))
        rewards = learner.rewards
        if config.reward_norm:
            earned = share_reward(steps.reward, steps.observation.agent_mask, config.reward == "team")
            rewards = follow_returns(rewards, earned, steps.observation.agent_mask)
        env_steps = learner.env_steps + num_envs * num_steps
        exploration = parts.exploration.follow(learner.exploration, steps)
        learner = learner._replace(replay=replay, rewards=rewards, exploration=exploration, env_steps=env_steps)
        hyper = learner.hyper
        learning_rate = progress_between(
            hyper.learning_rate, hyper.learning_rate_end, env_steps / hyper.planned_steps
        )

        def gradient_step(learner: LearnerState, key: PRNGKey) -> tuple[LearnerState, Metrics]:
            rows_key, env_key, turn_key, noise_key = jax.random.split(key, 4)
            rows = ring.sample_windows(replay, rows_key, config.batch_size, window)
            envs = jax.random.randint(env_key, (config.batch_size,), 0, num_envs)
            sampled = replay.items.at[rows, envs].get(mode="promise_in_bounds")
            batch = jax.vmap(jax.vmap(unpack))(sampled)
            if config.augment:
                batch = batch._replace(transition=turn_experience(env, batch.transition, turn_key))
            keys = jax.random.split(noise_key, config.batch_size)
            gradients, metrics = jax.grad(loss, has_aux=True)(learner.network, learner, rewards, batch, keys)
            directions, optimizer = adam.update(gradients, learner.optimizer)
            network = jax.tree.map(lambda w, d: w - learning_rate * d, learner.network, directions)
            target = jax.tree.map(lambda old, new: old + hyper.target_step * (new - old), learner.target, network)
            return learner._replace(network=network, target=target, optimizer=optimizer), metrics

        light = learner._replace(replay=())  # the loops below must not carry, and copy, the replay

        def learn(learner: LearnerState) -> tuple[LearnerState, Metrics]:
            learner, metrics = jax.lax.scan(gradient_step, learner, jax.random.split(key, config.updates))
            return learner, jax.tree.map(lambda values: values.mean(), metrics)

        told = jax.eval_shape(learn, light)[1]
        nothing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), told)
        ready = env_steps >= max(config.learning_starts, window * num_envs)
        light, metrics = jax.lax.cond(ready, learn, lambda learner: (learner, nothing), light)
        level = parts.exploration.level(exploration, env_steps)
        metrics |= {"epsilon": level.epsilon, "temperature": level.temperature, "learning_rate": learning_rate}
        return light._replace(replay=replay), metrics

    return Algorithm(init, initial_memory, policy, update, hyper)
