"""How much is said: the bits of the symbols that agents send."""

from collections.abc import Sequence

import equinox as eqx
import jax
import numpy as np

from gacrl.config.algorithms import NetworkConfig
from gacrl.envs.environment import Environment
from gacrl.evaluation.episodes import Episode
from gacrl.networks.agent import AgentNetwork, words_said
from gacrl.networks.communication import kind_of


def bits_sent(env: Environment, config: NetworkConfig) -> float | None:
    """Count the bits that an agent sends in a step of greedy play, all rounds together; None where it sends nothing.

    A symbol has log2 of the vocabulary, with a gate of one more; any other number what its kind says.
    """
    network = eqx.filter_eval_shape(AgentNetwork, env, config, 1, jax.random.key(0))
    said = words_said(network, env)
    if said is None:
        return None
    rounds, _, numbers = said
    kind = kind_of(config)
    if kind.sends_symbols:
        return rounds * float(np.log2(numbers + config.gate))
    return rounds * numbers * kind.bits_of_number


def bits_used(episodes: Sequence[Episode]) -> float | None:
    """Return the entropy of the symbol of an agent's last round, over all agents, steps and episodes, in bits.

    What a code made for these frequencies would need for each; at most log2 of the vocabulary. None where nothing
    is said, or messages are no symbols.
    """
    counts = None
    for episode in episodes:
        if episode.messages is None or not _symbols(episode.messages[:, -1]):
            return None
        spoken = episode.messages[:, -1][episode.agent_mask].sum(0)
        counts = spoken if counts is None else counts + spoken
    if counts is None or counts.sum() == 0:
        return None
    share = counts[counts > 0] / counts.sum()
    return float(-(share * np.log2(share)).sum()) + 0.0  # no −0


def _symbols(messages: np.ndarray) -> bool:
    """Every message is a one-hot, or nothing."""
    return bool(np.isin(messages, (0.0, 1.0)).all() and (messages.sum(-1) <= 1).all())
