"""Bits of symbols, by hand."""

from dataclasses import replace

import numpy as np
import pytest

from gacrl.evaluation.episodes import Episode
from gacrl.messages.bits import bits_used


def episode(symbols: list[list[int]], vocabulary: int = 4) -> Episode:
    """Two agents that send these; −1: nothing."""
    spoken = np.array(symbols)
    steps = len(spoken)
    messages = np.where(spoken[:, None, :, None] == np.arange(vocabulary), 1.0, 0.0)
    return Episode(
        actions=np.zeros((steps, 2), int),
        messages=messages,
        adjacency=np.ones((steps, 2, 2), bool),
        reward=np.zeros((steps, 2)),
        reward_raw=np.zeros(steps),
        agent_mask=np.ones((steps, 2), bool),
    )


@pytest.mark.parametrize(
    ("symbols", "bits"),
    [
        ([[0, 1], [2, 3]], 2.0),
        ([[0, 0], [1, 1]], 1.0),
        ([[0, 0], [0, 1]], 0.8112781),  # ¾ log2(4/3) + ¼ log2(4)
        ([[2, 2]], 0.0),
        ([[2, -1]], 0.0),
    ],
)
def test_bits_are_the_entropy_of_what_is_sent(symbols: list[list[int]], bits: float):
    assert bits_used([episode(symbols)]) == pytest.approx(bits)


def test_episodes_are_counted_together_and_padding_not():
    first, second = episode([[0, 0], [0, 0]]), episode([[1, 1]])
    assert bits_used([first, second, second]) == pytest.approx(1.0)
    padded = replace(episode([[0, 3], [1, 3]]), agent_mask=np.array([[True, False], [True, False]]))
    assert bits_used([padded]) == pytest.approx(1.0)
    # What is in the place of an agent that has left, or has not come yet, is not said.
    joining = replace(episode([[0, 3], [1, 1]]), agent_mask=np.array([[True, False], [True, True]]))
    assert bits_used([joining]) == pytest.approx(0.9182958)  # ⅓ log2(3) + ⅔ log2(3/2)


def test_the_last_round_is_counted_whatever_was_said_before():
    """Symbols of an earlier round, and numbers that are none, as the paper's agents send along the graph."""
    last = episode([[0, 1], [2, 3]])
    assert last.messages is not None
    for earlier in (0 * last.messages + [1.0, 0, 0, 0], np.full(last.messages.shape, -1.5)):
        said = np.concatenate([earlier, last.messages], axis=1)
        assert bits_used([replace(last, messages=said)]) == pytest.approx(2.0)


def test_what_is_no_symbol_has_no_bits():
    said = episode([[0, 1]])
    assert bits_used([replace(said, messages=None)]) is None
    assert bits_used([replace(said, messages=np.full((1, 1, 2, 4), 0.25))]) is None
    assert bits_used([episode([[-1, -1]])]) is None
