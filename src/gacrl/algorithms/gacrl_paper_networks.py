"""The networks of the paper's GACRL, equations (2) to (12), and one forward pass through them.

Equation (1) is in `tasks.spread.shaping`, the encoder (2)–(3) in `networks.encoder`, the graph (4) and (7) in
`networks.graph`, Gumbel-Softmax (9) in `networks.messages`.
"""

from math import prod
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from gacrl.config.algorithms import GacrlPaperConfig
from gacrl.networks.arrives import arriving
from gacrl.networks.encoder import Encoder, sample_latent
from gacrl.networks.graph import neighbour_sum
from gacrl.networks.layers import Linear
from gacrl.networks.messages import gumbel_softmax, most_likely_symbol, normal_and_gumbel
from gacrl.types import Arrives, PRNGKey

ROUNDS = 2
"""Agents hear each other twice in a step: the sum of (7), and the symbols of (10)."""


class MessageModel(eqx.Module):
    """Equations (5) to (9) without the sampling: one round of message passing over the graph."""

    w1: Linear
    w2: Linear
    w3: Linear
    w4: Linear

    def __init__(self, latent_size: int, hidden_size: int, vocabulary: int, key: PRNGKey):
        k1, k2, k3, k4 = jax.random.split(key, 4)
        self.w1 = Linear(latent_size, hidden_size, k1)
        self.w2 = Linear(hidden_size, vocabulary, k2)
        self.w3 = Linear(hidden_size + vocabulary, hidden_size, k3)
        self.w4 = Linear(hidden_size, vocabulary, k4)

    def __call__(
        self, latent: Float[Array, "Z N"], adjacency: Bool[Array, "N N"], arrives: Arrives
    ) -> tuple[Float[Array, "V N"], Float[Array, "V N"]]:
        """Return what each agent sends along the graph, and the logits of its outgoing symbol."""
        h1 = jax.nn.relu(self.w1(latent, axis=0))  # (5)
        m = self.w2(h1, axis=0)  # (6)
        m_sum = neighbour_sum(arriving(m.T, arrives, 0, ROUNDS).T, adjacency)  # (7)
        h2 = jax.nn.relu(self.w3(jnp.concatenate([h1, m_sum]), axis=0))  # (8)
        return m, self.w4(h2, axis=0)


class PolicyNetwork(eqx.Module):
    """Equation (11), with the hidden layer that W6 ∈ R^{5×32} needs: input-64-32-5."""

    w5: Linear
    hidden: Linear
    w6: Linear

    def __init__(self, in_size: int, hidden_sizes: tuple[int, int], num_actions: int, key: PRNGKey):
        k5, k_hidden, k6 = jax.random.split(key, 3)
        self.w5 = Linear(in_size, hidden_sizes[0], k5)
        self.hidden = Linear(hidden_sizes[0], hidden_sizes[1], k_hidden)
        self.w6 = Linear(hidden_sizes[1], num_actions, k6)

    def __call__(self, x: Float[Array, "X N"]) -> Float[Array, "A N"]:
        """Returns the logits of the actions."""
        hidden = jax.nn.relu(self.hidden(jax.nn.relu(self.w5(x, axis=0)), axis=0))
        return self.w6(hidden, axis=0)


class Critic(eqx.Module):
    """Equation (12), with the hidden layer that W8 ∈ R^{1×64} needs: input-128-64-1."""

    w7: Linear
    hidden: Linear
    w8: Linear

    def __init__(self, in_size: int, hidden_sizes: tuple[int, int], key: PRNGKey):
        k7, k_hidden, k8 = jax.random.split(key, 3)
        self.w7 = Linear(in_size, hidden_sizes[0], k7)
        self.hidden = Linear(hidden_sizes[0], hidden_sizes[1], k_hidden)
        self.w8 = Linear(hidden_sizes[1], 1, k8)

    def __call__(self, features: Float[Array, "N O"]) -> Float[Array, ""]:
        """V(s) of the global state s = [o_1, …, o_N]."""
        s = features.reshape(-1)
        hidden = jax.nn.relu(self.hidden(jax.nn.relu(self.w7(s, axis=0)), axis=0))
        return self.w8(hidden, axis=0)[0]


class Network(eqx.Module):
    """All that is learned: equations (2) to (12)."""

    encoder: Encoder
    message_model: MessageModel
    policy: PolicyNetwork
    critic: Critic


class Noise(NamedTuple):
    """What a forward pass draws: ε of (3), and the Gumbel noise of (9)."""

    latent: Float[Array, "Z N *b"]
    gumbel: Float[Array, "V N *b"]


def draw_noise(
    key: PRNGKey, num_agents: int, num_actions: int, config: GacrlPaperConfig, *batch: int
) -> tuple[Noise, Float[Array, "N A"]]:
    """Return the noise of a forward pass, and Gumbel noise to choose the actions with (none for 0 actions).

    One draw serves all: a call of the generator costs more than the few numbers in it.
    """
    num_latent = config.latent_size * num_agents * prod(batch)
    num_gumbel = config.vocabulary * num_agents * prod(batch)
    num_choice = num_agents * num_actions
    normal, gumbel = normal_and_gumbel(key, num_latent, num_gumbel + num_choice)
    noise = Noise(
        normal.reshape(config.latent_size, num_agents, *batch),
        gumbel[:num_gumbel].reshape(config.vocabulary, num_agents, *batch),
    )
    return noise, gumbel[num_gumbel:].reshape(num_agents, num_actions)


class Forward(NamedTuple):
    """What one forward pass over one environment's agents computes, a column for each agent."""

    logits: Float[Array, "A N *b"]
    messages: Float[Array, "R V N *b"]
    """What is sent by (6), and the symbols of (9)."""
    mean: Float[Array, "Z N *b"]
    log_variance: Float[Array, "Z N *b"]


def forward(
    network: Network,
    features: Float[Array, "N O"],
    adjacency: Bool[Array, "N N"],
    temperature: Float[Array, ""],
    noise: Noise | None,
    straight_through: bool = False,
    arrives: Arrives = Arrives(),  # noqa: B008 it is a constant
) -> Forward:
    """Compute action logits from observations, equations (2) to (11), for the N agents of one environment.

    Agents stand in columns, as the paper's W z_i + b has them; `Linear` says why that is also fast.
    Without noise: the mean latent and each agent's most likely symbol (evaluation).
    """
    o = features.T
    mean, log_variance = network.encoder(o, axis=0)  # (2)
    z = mean if noise is None else sample_latent(mean, log_variance, noise.latent)  # (3)
    m, symbol_logits = network.message_model(z, adjacency, arrives)  # (5)-(8)
    if noise is None:
        symbol = most_likely_symbol(symbol_logits, axis=0)
    else:
        symbol = gumbel_softmax(symbol_logits, noise.gumbel, temperature, straight_through, axis=0)  # (9)
    heard = arriving(symbol.T, arrives, 1, ROUNDS).T
    received = jnp.broadcast_to(heard[:, None, :], (heard.shape[0], *adjacency.shape))
    if arrives.kept is not None:
        received = received * arrives.kept[None]
    x = jnp.concatenate([o, others_side_by_side(received), z])  # (10)
    return Forward(network.policy(x), jnp.stack([m, symbol]), mean, log_variance)  # (11)


def others_side_by_side(received: Float[Array, "V N N"]) -> Float[Array, "(N-1)*V N"]:
    """Return the messages part of equation (10): concat([m_j | j ≠ i]), j ascending, whoever is near.

    received: entry [:, i, j] is j's message as it reaches i.
    """
    num_agents = received.shape[1]
    if num_agents == 1:
        return jnp.zeros((0, 1))
    # Slot k holds agent k for those after it and agent k + 1 for the others.
    slots = [
        jnp.stack([received[:, i, k + (k >= i)] for i in range(num_agents)], axis=1) for k in range(num_agents - 1)
    ]
    return jnp.concatenate(slots)
