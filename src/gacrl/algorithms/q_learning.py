"""Q-learning of a team from replay, shared by QMIX, VDN, IQL, DIAL and GACRL: they pass what is theirs in `Parts`.

Top to bottom: what a learner passes, what is remembered, how agents act, the loss, one update. Double Q-learning
(van Hasselt et al. 2016), n-step targets, a target network that follows slowly. Messages are not
remembered but made anew by the network that is learning; of memories, the one at the start of a window is.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int

from gacrl.algorithms import replay as ring
from gacrl.algorithms.actions import ActionSet, choices
from gacrl.algorithms.augmentation import play, require_no_memory_in_symmetric_play, turn_experience
from gacrl.algorithms.contract import Algorithm
from gacrl.algorithms.exploration import Exploration, progress_between
from gacrl.algorithms.objectives import HUBER_DELTA, ValueNorm, follow_returns, huber, no_returns
from gacrl.algorithms.returns import n_step_returns, n_step_window, next_values
from gacrl.algorithms.shared import clipped_adam, mean_real, share_reward
from gacrl.algorithms.teaching import as_told, lesson, told
from gacrl.config.algorithms import QLearningConfig
from gacrl.config.kinds import EXPLORATION, resolve
from gacrl.config.run import TrainingConfig
from gacrl.envs.environment import Environment
from gacrl.messages import interventions
from gacrl.networks.agent import AgentNetwork, AgentOutput, matched, unroll, words_said
from gacrl.networks.layers import redrawn
from gacrl.networks.memory import beginnings, restarted
from gacrl.types import Arrives, Decision, Memory, Metrics, Observation, Policy, PRNGKey, Rollout, Transition


class Network(eqx.Module):
    """What is learned: the agents' network, whose head gives a number for each action, and the team's part."""

    agent: AgentNetwork
    team: Any
    teacher: AgentNetwork | None = None
    """Told what others see, and learns from rewards in the agents' place, who learn from it what each action loses."""

    @property
    def judge(self) -> AgentNetwork:
        """The network that learns from rewards."""
        return self.agent if self.teacher is None else self.teacher


TeamValue = Callable[[Network, AgentOutput, Int[Array, " N"], Observation], Float[Array, " M"]]
"""(network, its output, actions, observation) -> what is learned: the team's value, or each agent's."""


def message_loss(output: AgentOutput, observation: Observation) -> Metrics:
    """The loss that a kind of message has of its own, the mean over the real agents; {} for none."""
    if output.message_loss is None:
        return {}
    return {"loss_messages": mean_real(output.message_loss, observation.agent_mask)}


class Parts(NamedTuple):
    """What makes a learner out of this file."""

    networks: Callable[[PRNGKey], Network]
    team_value: TeamValue
    own_values: bool = False
    """Whether each agent's value is learned by itself: it ends with the agent's life, the team's does not."""
    auxiliary: Callable[[AgentOutput, Observation], Metrics] = message_loss
    """Further terms of the loss, weighted already, from what the network put out and was shown; {} for none."""


@dataclass(frozen=True)
class Setup:
    """What is settled before anything is learned: constants of every function below."""

    config: QLearningConfig
    env: Environment
    actions: ActionSet
    parts: Parts
    explorer: Exploration
    adam: optax.GradientTransformation
    num_envs: int
    num_steps: int
    network: Network
    """Its shapes."""
    fresh: Memory
    """The network's memory at an episode's start."""
    arrives: Arrives
    """The shapes of what arrives in a step, where somebody intervenes while training."""

    @property
    def window(self) -> int:
        """W: steps of a replayed window, those that are learned from and those whose rewards their targets hold."""
        return self.config.sequence_length + self.config.n_step - 1

    @property
    def rows(self) -> int:
        """Of the replay: a multiple of a rollout's steps, and at least a window."""
        rollouts = -(-self.config.replay_capacity // (self.num_envs * self.num_steps))
        return max(rollouts, -(-self.window // self.num_steps)) * self.num_steps

    @property
    def forgetful(self) -> bool:
        """The network has no memory."""
        return not jax.tree.leaves(self.fresh)


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


def make(
    config: QLearningConfig, env: Environment, training: TrainingConfig, progress: str | None, parts: Parts
) -> Algorithm:
    """The learner for this task's shapes. progress: the measure that exploration may follow."""
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
        learned=lambda learner: learner._replace(**dict.fromkeys(LearnerState._fields[2:], ())),
        replay=lambda learner: learner.replay,
        batch_steps=config.batch_size * q.window,
        library_sums=config.network.recurrent and not network.agent.communication.heard_late,
    )


def agents_alone(config: QLearningConfig, env: Environment) -> Callable[[PRNGKey], Network]:
    """The networks of a learner whose team learns nothing of its own."""
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
    """What the agents act with, without what taught them."""
    pupils = [replace(network, teacher=None) for network in (learner.network, learner.target)]
    return learner._replace(network=pupils[0], target=pupils[1], optimizer=(), replay=(), rewards=())


def init(q: Setup, key: PRNGKey, hyper: Hyper) -> LearnerState:
    """A learner that has learned nothing."""
    network = redrawn(q.parts.networks(key), key)
    return LearnerState(
        network=network,
        target=network,
        optimizer=q.adam.init(network),  # pyright: ignore[reportArgumentType] a module is a pytree
        replay=ring.empty(jnp.zeros((q.num_envs, ring.packing(partial(example, q))[0])), q.rows),
        rewards=no_returns(),
        exploration=q.explorer.init(),
        env_steps=jnp.zeros((), jnp.int32),
        hyper=jax.tree.map(lambda number: jnp.asarray(number, float), hyper),
    )


def initial_memory(q: Setup, num_agents: int) -> Memory:
    """The policy's memory at an episode's start; () where there is none."""
    memory = ActMemory(q.network.agent.initial_memory(num_agents), q.explorer.initial_memory)
    return memory if jax.tree.leaves(memory) else ()


def example(q: Setup) -> Experience:
    """A step's shapes."""
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
    """The best available action, or with probability ε any available one."""
    explore_key, action_key = jax.random.split(key)
    anything = jax.random.categorical(action_key, jnp.where(action_mask, 0.0, -jnp.inf))
    exploring = jax.random.bernoulli(explore_key, epsilon, anything.shape)
    return jnp.where(exploring, anything, greedy(values, action_mask))


def greedy(values: Float[Array, "N A"], action_mask: Bool[Array, "N A"]) -> Int[Array, " N"]:
    """The best available action of each agent."""
    return jnp.where(action_mask, values, -jnp.inf).argmax(-1)


def policy(q: Setup, learner: LearnerState, explore: bool) -> Policy:
    """ε-greedy with the network that learns, or greedy, then with the averaged one if so configured."""
    network = learner.target if q.config.averaged and not explore else learner.network
    level = q.explorer.level(learner.exploration, learner.env_steps)

    def act(memory: Memory, observation: Observation, key: PRNGKey) -> tuple[Decision, Memory]:
        remembered = memory if isinstance(memory, ActMemory) else ActMemory((), ())
        mode_key, talk_key, action_key = jax.random.split(key, 3)
        before, mode = remembered.network, remembered.exploration
        if explore:
            output, after = network.agent(observation, before, talk_key, level.temperature)
            mode, epsilon = q.explorer.begin(mode, mode_key, level.epsilon)
            available = q.actions.mask(observation.action_mask)
            choice = epsilon_greedy(action_key, output.head, available, epsilon)
        else:
            symmetric = q.config.symmetric_play
            output, after = play(q.env, symmetric, network.agent, observation, before, level.temperature)
            choice = greedy(output.head, q.actions.mask(observation.action_mask))
        best = greedy(output.head, q.actions.mask(observation.action_mask))
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
    """The team's value of the best actions; by a teacher it is what it says without a memory, NaN once it has gone."""
    if q.network.teacher is not None:
        if network.teacher is None:
            return jnp.nan
        output = network.teacher(told(observation), network.teacher.initial_memory(q.env.num_agents))[0]
    return q.parts.team_value(network, output, best, observation).mean()


class Pair(NamedTuple):
    """The network that learns and the one that values, and how soft symbols are at the moment."""

    network: Network
    target: Network
    temperature: Float[Array, ""] | float


class Looks(NamedTuple):
    """What networks make of windows: what they put out, and their memory after each step."""

    online: tuple[AgentOutput, Memory]
    """Of the network that learns from rewards; without a memory, of the steps that are learned from."""
    theirs: tuple[AgentOutput, Memory] | None
    """Of the target network; None without a memory."""
    pupil: AgentOutput | None
    """Of a teacher's pupils; None where nobody is taught."""


def along(
    network: AgentNetwork, steps: Transition, memory: Memory, keys: Array | None, temperature: Array | float
) -> tuple[AgentOutput, Memory]:
    """Along windows [W, B, …]; keys and memory [B, …]."""
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
    """The target network's value of the actions that are best: by the online network with double Q."""
    best = greedy((chooser if q.config.double_q else theirs).head, q.actions.mask(observation.action_mask))
    return q.parts.team_value(target, theirs, best, observation)


def bootstrap(
    q: Setup, pair: Pair, observation: Observation, memory: Memory, target_memory: Memory
) -> Float[Array, " M"]:
    """The same of an observation that is yet to be looked at."""
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
    """The value of what followed each step of a window that both networks have been unrolled along."""
    value = jax.vmap(lambda *now: best_value(q, pair.target, *now))(theirs[0], online[0], seen.observation)
    memories = online[1], theirs[1]
    if seen.left is not None:
        memories = jax.vmap(restarted, (None, 0, 0))((q.fresh, q.fresh), memories, seen.left)

    def anew(at: Int[Array, " K"]) -> Float[Array, "K M"]:
        ends = jax.tree.map(lambda leaf: leaf[at], (seen.next_observation, *memories))
        return jax.vmap(lambda *end: bootstrap(q, pair, *end))(*ends)

    return next_values(value, seen.truncated, q.env.shortest_truncated, anew)


def window_loss(
    q: Setup, pair: Pair, gamma: Float[Array, ""] | float, rewards: ValueNorm, heard: Transition, looks: Looks
) -> tuple[Float[Array, ""], Metrics]:
    """The loss on one window [W, …] of one environment."""
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
    shared = q.config.reward == "team" or not q.parts.own_values  # the team's value is learned from its reward
    reward = share_reward(seen.reward, seen.observation.agent_mask, shared)
    reward = rewards.normalise(reward)[:, : value.shape[-1]]
    error = value - jax.lax.stop_gradient(window_targets(q, seen, reward, future, ends, gamma))
    real = now.observation.agent_mask if error.shape[-1] > 1 else jnp.ones(error.shape, bool)
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


class Ends(NamedTuple):
    """Where the targets of a window's learned steps bootstrap."""

    weight: Float[Array, "n W"] | None
    """Which of the n steps from each on belong to its target; None where agents' lives have ends of their own."""
    at: Int[Array, " at"]
    """Steps after which a value is needed: the last of each target, or every step."""


def window_ends(q: Setup, seen: Transition) -> Ends:
    """Of each learned step; where each agent's value is learned and lives end inside episodes, of every step."""
    if q.parts.own_values and seen.left is not None:
        return Ends(None, jnp.arange(q.window))
    weight, last = n_step_window(seen.terminated | seen.truncated, q.config.n_step)
    return Ends(weight, last[: q.config.sequence_length])


def window_targets(
    q: Setup,
    seen: Transition,
    reward: Float[Array, "W M"],
    future: Float[Array, "at M"],
    ends: Ends,
    gamma: Float[Array, ""] | float,
) -> Float[Array, "L M"]:
    """n rewards and then the value that followed; fewer rewards where the episode, or a life of its own, ends."""
    learned, n = q.config.sequence_length, q.config.n_step
    if ends.weight is None:
        assert seen.left is not None
        over = seen.terminated[:, None] | seen.left
        cut = jnp.broadcast_to(seen.truncated[:, None], over.shape)
        return n_step_returns(reward, future, over, cut, gamma, n)[:learned]
    earned = sum(gamma**k * ends.weight[k, :learned, None] * reward[k : k + learned] for k in range(n))
    length = ends.at - jnp.arange(learned) + 1
    discount = gamma ** length[:, None] * ~seen.terminated[ends.at][:, None]
    return earned + discount * future


def loss(
    q: Setup, network: Network, learner: LearnerState, rewards: ValueNorm, batch: Experience, keys: Array
) -> tuple[Float[Array, ""], Metrics]:
    """The mean over windows [W, B, …]."""
    level = q.explorer.level(learner.exploration, learner.env_steps)
    pair = Pair(network, learner.target, level.temperature)
    one = partial(window_loss, q, pair, learner.hyper.gamma, rewards)
    losses = jax.vmap(one, 1)(batch.transition, look(q, pair, batch, keys))
    return jax.tree.map(lambda values: values.mean(0), losses)


def remember(q: Setup, learner: LearnerState, steps: Transition) -> LearnerState:
    """Take in a rollout [T, E, …]: the replay, the moments of the reward, and what exploration follows."""
    kept = steps._replace(decision=Decision(steps.decision.extras["choice"]), info={})
    block = Experience(kept, steps.decision.extras["memory"])
    replay = ring.add_block(learner.replay, jax.vmap(jax.vmap(ring.pack))(block))
    rewards = learner.rewards
    if q.config.reward_norm:
        earned = share_reward(steps.reward, steps.observation.agent_mask, q.config.reward == "team")
        rewards = follow_returns(rewards, earned, steps.observation.agent_mask)
    env_steps = learner.env_steps + q.num_envs * q.num_steps
    exploration = q.explorer.follow(learner.exploration, steps)
    return learner._replace(replay=replay, rewards=rewards, exploration=exploration, env_steps=env_steps)


class Standing(NamedTuple):
    """What stays as it is during an update."""

    replay: ring.Replay[Float[Array, "capacity E W"]]
    rewards: ValueNorm
    learning_rate: Float[Array, ""]
    target_step: Float[Array, ""] | float


def gradient_step(
    q: Setup, standing: Standing, learner: LearnerState, key: PRNGKey
) -> tuple[LearnerState, Metrics]:
    """One step of Adam on windows drawn from the replay; the target network follows."""
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
