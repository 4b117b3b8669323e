"""Q-learning of a team from replay, shared by QMIX, VDN, IQL, DIAL and GACRL: they pass what is theirs in `Parts`.

Top to bottom: the record, how agents act, what is remembered, one update. `Parts` and the other records are in
`q_learner`, the loss with double Q-learning and n-step targets in `q_loss`; a target network follows slowly. Messages
are not remembered but made anew by the network that is learning; of memories, the one at the start of a window is.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from gacrl.algorithms import replay as ring
from gacrl.algorithms.actions import choices, greedy
from gacrl.algorithms.augmentation import play, require_no_memory_in_symmetric_play, turn_experience
from gacrl.algorithms.contract import Algorithm
from gacrl.algorithms.exploration import Exploration, progress_between
from gacrl.algorithms.objectives import RewardNorm, follow_returns, no_rewards
from gacrl.algorithms.q_learner import ActMemory, Experience, Hyper, LearnerState, Network, Parts, Setup
from gacrl.algorithms.q_loss import loss
from gacrl.algorithms.shared import clipped_adam, share_reward
from gacrl.algorithms.teaching import told
from gacrl.config.algorithms import QLearningConfig
from gacrl.config.kinds import EXPLORATION, resolve
from gacrl.config.run import TrainingConfig
from gacrl.envs.environment import Environment
from gacrl.messages import interventions
from gacrl.networks.agent import AgentNetwork, AgentOutput, matched, words_said
from gacrl.networks.layers import redrawn
from gacrl.types import Decision, Memory, Metrics, Observation, Policy, PRNGKey, Rollout, Transition


def make(
    config: QLearningConfig, env: Environment, training: TrainingConfig, progress: str | None, parts: Parts
) -> Algorithm:
    """Make the learner for this task's shapes. progress: the measure that exploration may follow.

    Raises ConfigError for an intervention in training where nothing is said, and for symmetric play with a memory.
    """
    explore: Callable[..., Exploration] = resolve(EXPLORATION[config.exploration])
    network = eqx.filter_eval_shape(parts.networks, jax.random.key(0))
    q = Setup(
        config=config,
        env=env,
        actions=choices(env),
        parts=parts,
        explorer=explore(config, training.env_steps, progress),
        adam=clipped_adam(config.max_grad_norm),
        num_envs=training.num_envs,
        num_steps=training.num_steps,
        network=network,
        fresh=network.agent.initial_memory(env.num_agents),
        arrives=interventions.example(training.intervention, partial(words_said, network.agent, env)),
    )
    require_no_memory_in_symmetric_play(config, env, q.fresh)
    return Algorithm(
        init=partial(init, q),
        initial_memory=partial(initial_memory, q),
        policy=partial(policy, q),
        update=partial(update, q),
        hyper=Hyper(
            learning_rate=config.learning_rate,
            learning_rate_end=config.learning_rate_end,
            gamma=config.gamma,
            target_step=config.target_step,
            planned_steps=training.env_steps,
        ),
        acting=acting,
        network=None if config.symmetric_play else partial(playing, config.averaged),
        parameters=lambda learner: learner.network,
        learned=lambda learner: learner._replace(
            optimizer=(), replay=(), rewards=(), exploration=(), env_steps=(), hyper=()
        ),
        replay=lambda learner: learner.replay,
        batch_steps=config.batch_size * q.window,
        library_sums=config.network.recurrent and not network.agent.communication.heard_late,
    )


def agents_alone(config: QLearningConfig, env: Environment) -> Callable[[PRNGKey], Network]:
    """Return the networks of a learner whose team learns nothing of its own."""
    num_choices = choices(env).size
    settings = matched(env, config.network, num_choices)

    def networks(key: PRNGKey) -> Network:
        agent_key, _ = jax.random.split(key)
        return Network(AgentNetwork(env, settings, num_choices, agent_key), ())

    return networks


def playing(averaged: bool, learner: LearnerState) -> AgentNetwork:
    """Return the network that plays greedily."""
    return (learner.target if averaged else learner.network).agent


def acting(learner: LearnerState) -> LearnerState:
    """Return what the agents act with, without what taught them."""
    pupils = [replace(network, teacher=None) for network in (learner.network, learner.target)]
    return learner._replace(network=pupils[0], target=pupils[1], optimizer=(), replay=(), rewards=())


def init(q: Setup, key: PRNGKey, hyper: Hyper) -> LearnerState:
    """Make a learner that has learned nothing."""
    network = redrawn(q.parts.networks(key), key)
    return LearnerState(
        network=network,
        target=network,
        optimizer=q.adam.init(network),  # pyright: ignore[reportArgumentType] a module is a pytree
        replay=ring.empty(jnp.zeros((q.num_envs, ring.packing(partial(example, q))[0])), q.rows),
        rewards=no_rewards(),
        exploration=q.explorer.init(),
        env_steps=jnp.zeros((), jnp.int32),
        hyper=jax.tree.map(lambda number: jnp.asarray(number, float), hyper),
    )


def initial_memory(q: Setup, num_agents: int) -> Memory:
    """Return the policy's memory at an episode's start; () where there is none."""
    memory = ActMemory(q.network.agent.initial_memory(num_agents), q.explorer.initial_memory)
    return memory if jax.tree.leaves(memory) else ()


def example(q: Setup) -> Experience:
    """Return a step's shapes."""
    key, params = jax.random.key(0), q.env.default_params()
    state, observation = q.env.reset(key, params)
    choice = jnp.zeros(q.env.num_agents, jnp.int32)
    after, false = q.env.step(state, q.actions.act(choice), key, params)[1], jnp.zeros((), bool)
    seen, left = after.observation, after.left
    observation, seen = (it._replace(arrives=q.arrives) for it in (observation, seen))
    step = Transition(observation, Decision(choice), after.reward, false, false, false, seen, {}, left)
    return Experience(step, q.fresh)


def epsilon_greedy(
    key: PRNGKey, values: Float[Array, "N A"], action_mask: Bool[Array, "N A"], epsilon: Float[Array, ""] | float
) -> Int[Array, " N"]:
    """Return the best available action, or with probability ε any available one."""
    explore_key, action_key = jax.random.split(key)
    anything = jax.random.categorical(action_key, jnp.where(action_mask, 0.0, -jnp.inf))
    exploring = jax.random.bernoulli(explore_key, epsilon, anything.shape)
    return jnp.where(exploring, anything, greedy(values, action_mask))


def policy(q: Setup, learner: LearnerState, explore: bool) -> Policy:
    """Act ε-greedily with the network that learns, or greedily, then with the averaged one if so configured."""
    network = learner.target if q.config.averaged and not explore else learner.network
    level = q.explorer.level(learner.exploration, learner.env_steps)

    def act(memory: Memory, observation: Observation, key: PRNGKey) -> tuple[Decision, Memory]:
        remembered = memory if isinstance(memory, ActMemory) else ActMemory((), ())
        mode_key, talk_key, action_key = jax.random.split(key, 3)
        before, mode = remembered.network, remembered.exploration
        if explore:
            output, after = network.agent(observation, before, talk_key, level.temperature)
        else:
            symmetric = q.config.symmetric_play
            output, after = play(q.env, symmetric, network.agent, observation, before, level.temperature)
        available = q.actions.mask(observation.action_mask)
        choice = best = greedy(output.head, available)
        if explore:
            mode, epsilon = q.explorer.begin(mode, mode_key, level.epsilon)
            choice = epsilon_greedy(action_key, output.head, available, epsilon)
        extras = {
            "value": jnp.broadcast_to(value_now(q, network, output, best, observation), choice.shape),
            "choice": choice,
            "memory": before,
            "mode": mode,
        }
        decision = Decision(q.actions.act(choice), output.messages, output.adjacency, extras)
        return decision, ActMemory(after, mode) if isinstance(memory, ActMemory) else ()

    return act


def value_now(
    q: Setup, network: Network, output: AgentOutput, best: Int[Array, " N"], observation: Observation
) -> Float[Array, ""] | float:
    """Return the team's value of the best actions; by a teacher it is what it says without a memory, NaN once it has
    gone.
    """
    if q.network.teacher is not None:
        if network.teacher is None:
            return jnp.nan
        output = network.teacher(told(observation), network.teacher.initial_memory(q.env.num_agents))[0]
    return q.parts.team_value(network, output, best, observation).mean()


def remember(q: Setup, learner: LearnerState, steps: Transition) -> LearnerState:
    """Take in a rollout [T, E, …]: the replay, what rewards are like, and what exploration follows."""
    kept = steps._replace(decision=Decision(steps.decision.extras["choice"]), info={})
    block = Experience(kept, steps.decision.extras["memory"])
    replay = ring.add_block(learner.replay, jax.vmap(jax.vmap(ring.pack))(block))
    rewards = learner.rewards
    if q.config.reward_norm:
        earned = share_reward(steps, q.shares_reward)
        moments = follow_returns(rewards.moments, earned, steps.observation.agent_mask)
        rewards = RewardNorm(moments, rewards.ended | steps.terminated.any())
    env_steps = learner.env_steps + q.num_envs * q.num_steps
    exploration = q.explorer.follow(learner.exploration, steps)
    return learner._replace(replay=replay, rewards=rewards, exploration=exploration, env_steps=env_steps)


class Standing(NamedTuple):
    """What stays as it is during an update."""

    replay: ring.Replay[Float[Array, "capacity E W"]]
    rewards: RewardNorm
    learning_rate: Float[Array, ""]
    target_step: Float[Array, ""] | float


def gradient_step(
    q: Setup, standing: Standing, learner: LearnerState, key: PRNGKey
) -> tuple[LearnerState, Metrics]:
    """Take one step of Adam on windows drawn from the replay; the target network follows."""
    replay = standing.replay
    rows_key, env_key, turn_key, noise_key = jax.random.split(key, 4)
    batch_size = q.config.batch_size
    rows = ring.sample_windows(replay, rows_key, batch_size, q.window)
    envs = jax.random.randint(env_key, (batch_size,), 0, q.num_envs)
    sampled = replay.items.at[rows, envs].get(mode="promise_in_bounds")
    batch = jax.vmap(jax.vmap(ring.packing(partial(example, q))[1]))(sampled)
    if q.config.augment:
        batch = batch._replace(transition=turn_experience(q.env, q.actions, batch.transition, turn_key))
    keys = jax.random.split(noise_key, batch_size)
    gradient = jax.grad(partial(loss, q), has_aux=True)
    gradients, metrics = gradient(learner.network, learner, standing.rewards, batch, keys)
    directions, optimizer = q.adam.update(gradients, learner.optimizer)
    network = jax.tree.map(lambda w, d: w - standing.learning_rate * d, learner.network, directions)
    share = standing.target_step
    target = jax.tree.map(lambda old, new: old + share * (new - old), learner.target, network)
    return learner._replace(network=network, target=target, optimizer=optimizer), metrics


def update(q: Setup, learner: LearnerState, rollout: Rollout, key: PRNGKey) -> tuple[LearnerState, Metrics]:
    """Remember a rollout, then take the configured gradient steps."""
    learner = remember(q, learner, rollout.transitions)
    hyper, replay, env_steps = learner.hyper, learner.replay, learner.env_steps
    share = env_steps / hyper.planned_steps
    learning_rate = progress_between(hyper.learning_rate, hyper.learning_rate_end, share)
    step = partial(gradient_step, q, Standing(replay, learner.rewards, learning_rate, hyper.target_step))
    light = learner._replace(replay=())  # the loops below must not carry, and copy, the replay

    def learn(learner: LearnerState) -> tuple[LearnerState, Metrics]:
        learner, metrics = jax.lax.scan(step, learner, jax.random.split(key, q.config.updates))
        return learner, jax.tree.map(lambda values: values.mean(), metrics)

    metrics_of = jax.eval_shape(learn, light)[1]
    nothing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), metrics_of)
    ready = env_steps >= max(q.config.learning_starts, q.window * q.num_envs)
    light, metrics = jax.lax.cond(ready, learn, lambda learner: (learner, nothing), light)
    level = q.explorer.level(learner.exploration, env_steps)
    metrics |= {"epsilon": jnp.asarray(level.epsilon), "temperature": jnp.asarray(level.temperature)}
    return light._replace(replay=replay), {**metrics, "learning_rate": learning_rate}
