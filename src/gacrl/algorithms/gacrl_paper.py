"""GACRL exactly as the paper prints it: equations (2) to (20), read as docs/algorithm.md says.

Top to bottom: how agents act (9)–(16), the loss (17)–(20), one update. The networks (2)–(12) are in
`gacrl_paper_networks`, adaptive exploration (13)–(16) in `gacrl_paper_exploration`, equation (1) in
`tasks.spread.shaping`.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, Key

from gacrl.algorithms import replay as ring
from gacrl.algorithms.contract import Algorithm
from gacrl.algorithms.gacrl_paper_exploration import (
    Coverage,
    Schedule,
    adaptive_level,
    follow_coverage,
    linear_decay,
    no_coverage,
)
from gacrl.algorithms.gacrl_paper_networks import (
    ROUNDS,
    Critic,
    MessageModel,
    Network,
    Noise,
    PolicyNetwork,
    draw_noise,
    forward,
)
from gacrl.config.algorithms import GacrlPaperConfig
from gacrl.config.checks import require
from gacrl.config.run import TrainingConfig
from gacrl.envs.environment import Environment
from gacrl.messages import interventions
from gacrl.networks.encoder import Encoder, kl_divergence
from gacrl.networks.graph import heard_adjacency
from gacrl.networks.layers import redrawn
from gacrl.types import Arrives, Decision, Memory, Metrics, Observation, Policy, PRNGKey, Rollout, Transition


def behaviour_probabilities(logits: Float[Array, "*b A"], epsilon: Float[Array, ""]) -> Float[Array, "*b A"]:
    """Return what the agents act by: with probability ε uniformly, else by the policy of (11).

    Actions with a logit of −∞ are not available: neither part of the mixture takes them.
    """
    available = logits > -jnp.inf
    uniform = available / available.sum(-1, keepdims=True)
    return (1 - epsilon) * jax.nn.softmax(logits) + epsilon * uniform


class Experience(NamedTuple):
    """What the replay remembers of a step; latents and messages are recomputed from it."""

    features: Float[Array, "*b N O"]
    adjacency: Bool[Array, "*b N N"]
    action: Int[Array, "*b N"]
    reward: Float[Array, "*b"]
    """The team's reward as it was when earned: θ and the local ratio have moved on since."""
    arrives: Arrives
    """What reached the agents, where somebody intervened."""


def no_experience(p: "Setup") -> Experience:
    """Return zeros in the shapes of an experience."""
    num_agents, message = p.env.num_agents, (ROUNDS, p.env.num_agents, p.config.vocabulary)
    return Experience(
        features=jnp.zeros((num_agents, p.env.observation_size)),
        adjacency=jnp.zeros((num_agents, num_agents), bool),
        action=jnp.zeros(num_agents, jnp.int32),
        reward=jnp.zeros(()),
        arrives=interventions.example(p.intervention, lambda: message),
    )


class Hyper(NamedTuple):
    """Table I and what stands in the equations, as numbers that a sweep can vary."""

    learning_rate: Float[Array, ""] | float
    learning_rate_end: Float[Array, ""] | float
    epsilon: Schedule
    temperature: Schedule
    num_episodes: Float[Array, ""] | float
    radius: Float[Array, ""] | float
    critic_weight: Float[Array, ""] | float
    kl_weight: Float[Array, ""] | float


class LearnerState(NamedTuple):
    """What the paper's GACRL carries from update to update."""

    network: Network
    optimizer: optax.OptState
    replay: ring.Replay[Float[Array, "capacity W"]]
    """Of experiences, each packed into one vector."""
    coverage: Coverage
    hyper: Hyper


def log_probability(logits: Float[Array, "A N *b"], action: Int[Array, "N *b"]) -> Float[Array, "N *b"]:
    """Return log π of the actions taken, by equation (11) alone: ε is not part of it."""
    taken = jax.nn.one_hot(action, logits.shape[0], axis=0)
    return (jax.nn.log_softmax(logits, axis=0) * taken).sum(0)


def policy_loss(
    log_probability: Float[Array, "N rows"], reward: Float[Array, " rows"], batch_size: int
) -> Float[Array, ""]:
    """Compute equation (18): −log π · r, averaged over agents; the mean over the replayed rows plus the current row.

    The weight is the immediate reward, as printed: no return, no baseline, no importance ratio.
    """
    weighted = -log_probability.mean(0) * reward
    return weighted[:batch_size].mean() + weighted[batch_size:].sum()


def critic_loss(value: Float[Array, " B"], reward: Float[Array, " B"]) -> Float[Array, ""]:
    """Compute equation (19): the critic regresses the immediate reward."""
    return jnp.square(value - reward).mean()


def kl_loss(
    mean: Float[Array, "Z N B"], log_variance: Float[Array, "Z N B"], mean_over_latent: bool = False
) -> Float[Array, ""]:
    """Compute equation (20): without the ½, summed over the latent dimensions, averaged over agents and batch."""
    loss = 2.0 * kl_divergence(mean, log_variance, axis=0).mean()
    return loss / mean.shape[0] if mean_over_latent else loss


def loss(
    network: Network,
    hyper: Hyper,
    rows: Experience,
    temperature: Float[Array, ""],
    noise: Noise,
    config: GacrlPaperConfig,
) -> tuple[Float[Array, ""], Metrics]:
    """Compute equation (17) on B replayed rows and, as the last row, the current step.

    Latents, messages and log-probabilities are recomputed with the current weights and temperature.
    Returns the loss and its three parts.
    """
    batch_size = config.batch_size
    straight_through = config.messages == "straight_through"
    columns = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, -1), rows)
    output = jax.vmap(
        lambda row, noise: forward(
            network, row.features, row.adjacency, temperature, noise, straight_through, row.arrives
        ),
        in_axes=-1,
        out_axes=-1,
    )(columns, noise)
    value = jax.vmap(network.critic, in_axes=-1)(columns.features[..., :batch_size])
    parts = {
        "loss_policy": policy_loss(log_probability(output.logits, columns.action), rows.reward, batch_size),
        "loss_critic": critic_loss(value, rows.reward[:batch_size]),
        "loss_kl": kl_loss(
            output.mean[..., :batch_size],
            output.log_variance[..., :batch_size],
            mean_over_latent=config.kl_reduction == "mean",
        ),
    }
    total = parts["loss_policy"] + hyper.critic_weight * parts["loss_critic"] + hyper.kl_weight * parts["loss_kl"]
    return total, parts


@dataclass(frozen=True)
class Setup:
    """What is settled before anything is learned: constants of every function below."""

    config: GacrlPaperConfig
    env: Environment
    adam: optax.GradientTransformation
    followed: tuple[str, ...]
    """Measures that (13) and (14) may follow, the first of them that the task has."""
    intervention: str
    """What happens to messages while training."""

    @property
    def straight_through(self) -> bool:
        """Whether symbols are one-hot while learning."""
        return self.config.messages == "straight_through"


def make(
    config: GacrlPaperConfig,
    env: Environment,
    training: TrainingConfig = TrainingConfig(),  # noqa: B008 it is a constant
    progress: str | None = None,
) -> Algorithm:
    """Make the paper's algorithm for this task's shapes; its schedules count episodes, not environment steps.

    progress: what (13) and (14) follow in a task that has no coverage within θ. Raises ConfigError for continuous
    actions.
    """
    require(
        not env.continuous_actions,
        f"{config.name} needs discrete actions: leave env.continuous_actions at False, or take another preset",
    )
    p = Setup(
        config=config,
        env=env,
        adam=optax.flatten(optax.scale_by_adam()),  # one vector: a kernel for each of 28 arrays costs more
        followed=("coverage_theta",) if progress is None else ("coverage_theta", progress),
        intervention=training.intervention,
    )
    return Algorithm(
        init=partial(init, p),
        initial_memory=lambda num_agents: (),
        policy=partial(policy, p),
        update=partial(update, p),
        hyper=Hyper(
            learning_rate=config.learning_rate,
            learning_rate_end=config.learning_rate_end,
            epsilon=Schedule(config.epsilon, config.epsilon_end, config.epsilon_bonus),
            temperature=Schedule(config.temperature, config.temperature_end, config.temperature_bonus),
            num_episodes=config.schedule_episodes,
            radius=config.radius,
            critic_weight=config.critic_weight,
            kl_weight=config.kl_weight,
        ),
        acting=lambda learner: learner._replace(optimizer=(), replay=()),
        parameters=lambda learner: learner.network,
        learned=lambda learner: learner._replace(**dict.fromkeys(LearnerState._fields[1:], ())),
        replay=lambda learner: learner.replay,
        batch_steps=config.batch_size,
    )


def init(p: Setup, key: PRNGKey, hyper: Hyper) -> LearnerState:
    """Make a learner that has learned nothing."""
    config, num_agents, observation_size = p.config, p.env.num_agents, p.env.observation_size
    encoder_key, message_key, policy_key, critic_key = jax.random.split(key, 4)
    policy_input = observation_size + config.vocabulary * (num_agents - 1) + config.latent_size
    network = Network(
        Encoder(observation_size, config.encoder_hidden, config.latent_size, encoder_key),
        MessageModel(config.latent_size, config.message_hidden, config.vocabulary, message_key),
        PolicyNetwork(policy_input, config.policy_hidden, p.env.num_actions, policy_key),
        Critic(observation_size * num_agents, config.critic_hidden, critic_key),
    )
    network = redrawn(network, key)
    packed_size, _ = ring.packing(partial(no_experience, p))
    return LearnerState(
        network=network,
        optimizer=p.adam.init(network),  # pyright: ignore[reportArgumentType] a module is a pytree
        replay=ring.empty(jnp.zeros(packed_size), config.replay_capacity),
        coverage=no_coverage(),
        hyper=jax.tree.map(lambda number: jnp.asarray(number, float), hyper),
    )


def levels(p: Setup, learner: LearnerState) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return ε and τ of the moment, equations (13) to (16)."""
    hyper, episode = learner.hyper, learner.coverage.episode
    coverage = learner.coverage.signal(p.config.coverage_signal)
    return (
        adaptive_level(hyper.epsilon, episode, hyper.num_episodes, coverage),
        adaptive_level(hyper.temperature, episode, hyper.num_episodes, coverage),
    )


def policy(p: Setup, learner: LearnerState, explore: bool) -> Policy:
    """Act by (11), mixed with random actions while exploring; greedily, with the most likely symbols, if not."""
    epsilon, temperature = levels(p, learner)

    def act(memory: Memory, observation: Observation, key: PRNGKey) -> tuple[Decision, Memory]:
        num_agents, num_actions = p.env.num_agents, p.env.num_actions
        noise, choice = draw_noise(key, num_agents, num_actions, p.config) if explore else (None, None)
        adjacency = heard_adjacency(observation, learner.hyper.radius)
        output = forward(
            learner.network,
            observation.features,
            adjacency,
            temperature,
            noise,
            p.straight_through,
            observation.arrives,
        )
        logits = jnp.where(observation.action_mask, output.logits.T, -jnp.inf)
        if choice is None:
            action = logits.argmax(-1)
        else:  # the largest of log p + Gumbel noise is a sample of p
            action = (jnp.log(behaviour_probabilities(logits, epsilon)) + choice).argmax(-1)
        extras: dict[str, Any] = {"value": learner.network.critic(observation.features)}
        if noise is not None:
            extras["noise"] = noise
        return Decision(action, jnp.moveaxis(output.messages, 1, 2), adjacency, extras), memory

    return act


def learn_from_step(
    p: Setup, learner: LearnerState, step: Transition, key: PRNGKey
) -> tuple[LearnerState, Metrics]:
    """Remember one step of one environment, then take one gradient step of Adam."""
    sample_key, noise_key = jax.random.split(key)
    epsilon, temperature = levels(p, learner)
    current = Experience(
        step.observation.features,
        step.decision.adjacency,  # pyright: ignore[reportArgumentType] this policy always sets it
        step.decision.action,
        step.reward.mean(),
        step.observation.arrives,
    )
    replay = ring.add(learner.replay, ring.pack(current))
    sampled = ring.sample_rows(replay, sample_key, p.config.batch_size)
    _, unpack = ring.packing(partial(no_experience, p))
    rows = jax.vmap(unpack)(ring.take(replay, jnp.append(sampled, ring.newest(replay))))
    fresh, _ = draw_noise(noise_key, p.env.num_agents, 0, p.config, p.config.batch_size)
    noise = jax.tree.map(
        lambda fresh, acted: jnp.concatenate([fresh, acted[..., None]], axis=-1),
        fresh,
        step.decision.extras["noise"],
    )
    gradient = jax.grad(loss, has_aux=True)
    gradients, losses = gradient(learner.network, learner.hyper, rows, temperature, noise, p.config)
    directions, optimizer = p.adam.update(gradients, learner.optimizer)
    hyper = learner.hyper
    learning_rate = linear_decay(
        hyper.learning_rate, hyper.learning_rate_end, learner.coverage.episode, hyper.num_episodes
    )
    network = jax.tree.map(lambda w, d: w - learning_rate * d, learner.network, directions)
    learner = learner._replace(network=network, optimizer=optimizer, replay=replay)
    return learner, {**losses, "epsilon": epsilon, "temperature": temperature}


def learn_from_steps(
    p: Setup, learner: LearnerState, inputs: tuple[Transition, Key[Array, " E"]]
) -> tuple[LearnerState, Metrics]:
    """Learn from what E environments did at one time; coverage moves on when all of it is learned from."""
    steps = inputs[0]
    if steps.reward.shape[0] == 1:
        learner, metrics = learn_from_step(p, learner, *jax.tree.map(lambda leaf: leaf[0], inputs))
    else:
        learner, metrics = jax.lax.scan(
            lambda learner, inputs: learn_from_step(p, learner, *inputs), learner, inputs
        )
        metrics = jax.tree.map(lambda values: values.mean(0), metrics)
    done = steps.terminated | steps.truncated
    coverage = next((steps.info[name] for name in p.followed if name in steps.info), jnp.zeros(done.shape))
    return learner._replace(coverage=follow_coverage(learner.coverage, coverage, done)), metrics


def update(p: Setup, learner: LearnerState, rollout: Rollout, key: PRNGKey) -> tuple[LearnerState, Metrics]:
    """Take one gradient step per environment step, in the order in which they were taken."""
    time, environments = rollout.transitions.reward.shape[:2]
    single = time * environments == 1
    keys = key[None, None] if single else jax.random.split(key, (time, environments))
    learn = partial(learn_from_steps, p)
    if time == 1:
        return learn(learner, jax.tree.map(lambda leaf: leaf[0], (rollout.transitions, keys)))
    learner, metrics = jax.lax.scan(learn, learner, (rollout.transitions, keys))
    return learner, jax.tree.map(lambda values: values.mean(0), metrics)
