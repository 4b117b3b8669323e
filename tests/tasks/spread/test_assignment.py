"""The assignment against scipy's, and what it promises for ties, huge and forbidden costs."""

from collections.abc import Callable

import hypothesis.extra.numpy as hnp
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linear_sum_assignment

from gacrl.tasks.spread.assignment import assign

assign_one = jax.jit(assign)
assign_many = jax.jit(jax.vmap(assign))


def check_valid(landmarks: np.ndarray, num_landmarks: int) -> None:
    taken = landmarks[landmarks >= 0]
    assert landmarks.dtype == np.int32
    assert len(set(taken)) == len(taken) == min(len(landmarks), num_landmarks)
    assert landmarks.min() >= -1
    assert landmarks.max() < num_landmarks


def total(cost: np.ndarray, landmarks: np.ndarray) -> float:
    """Sum of the assigned pairs' costs, in double precision; validity is checked on the way."""
    check_valid(landmarks, cost.shape[1])
    agents = np.flatnonzero(landmarks >= 0)
    return float(cost[agents, landmarks[agents]].sum(dtype=np.float64))


def optimum(cost: np.ndarray) -> float:
    return float(cost[linear_sum_assignment(cost.astype(np.float64))].sum(dtype=np.float64))


def distances(seed: int, batch: int, num_agents: int, num_landmarks: int) -> np.ndarray:
    """[batch N L] between uniform points in a square of side 2."""
    rng = np.random.default_rng(seed)
    agents = rng.uniform(-1, 1, (batch, num_agents, 1, 2))
    landmarks = rng.uniform(-1, 1, (batch, 1, num_landmarks, 2))
    return np.linalg.norm(agents - landmarks, axis=-1).astype(np.float32)


# Both orientations, and sizes on both sides of the line between the methods (120 candidates).
SMALL = [(1, 1), (121, 1), (3, 3), (5, 5), (6, 6), (7, 3), (4, 11)]


@pytest.mark.parametrize("shape", SMALL, ids=str)
def test_small_teams_are_exact(shape: tuple[int, int]):
    rng = np.random.default_rng(0)
    continuous = rng.normal(size=(150, *shape))
    tied = rng.integers(-2, 3, size=(150, *shape))
    costs = np.concatenate([continuous, tied]).astype(np.float32)
    for cost, landmarks in zip(costs, np.asarray(assign_many(costs)), strict=True):
        assert total(cost, landmarks) == pytest.approx(optimum(cost), abs=1e-5)


@pytest.mark.parametrize(("num_agents", "batch"), [(10, 32), (30, 8), (100, 4), (300, 2)])
@pytest.mark.parametrize("power", [1, 2])
def test_large_teams_are_optimal_to_rounding(num_agents: int, batch: int, power: int):
    costs = distances(num_agents, batch, num_agents, num_agents) ** power
    for cost, landmarks in zip(costs, np.asarray(assign_many(costs)), strict=True):
        assert total(cost, landmarks) == pytest.approx(optimum(cost), rel=1e-5)


def test_by_hand():
    # Greedy would send agent 0 to landmark 0 and pay 1 + 9 instead of 2 + 3.
    cost = jnp.array([[1.0, 2.0], [3.0, 9.0]])
    np.testing.assert_array_equal(assign_one(cost), [1, 0])
    # The third agent would only displace a cheaper one.
    cost = jnp.array([[5.0, 0.0], [0.0, 5.0], [4.0, 4.0]])
    np.testing.assert_array_equal(assign_one(cost), [1, 0, -1])


DEGENERATE: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "all equal": np.zeros_like,
    "agents in one spot": lambda cost: np.broadcast_to(cost[:1], cost.shape).copy(),
    "landmarks in three spots": lambda cost: cost[:, np.arange(cost.shape[1]) % 3],
    "rounded": lambda cost: np.round(4 * cost),
    "negative": lambda cost: -100.0 - cost,
    "near the largest float": lambda cost: np.float32(1.5e38) * (cost - 1.0),
}


@pytest.mark.parametrize("change", DEGENERATE.values(), ids=DEGENERATE.keys())
@pytest.mark.parametrize("num_agents", [4, 40])
def test_degenerate_costs(num_agents: int, change: Callable[[np.ndarray], np.ndarray]):
    cost = change(distances(0, 1, num_agents, num_agents)[0]).astype(np.float32)
    assert np.isfinite(cost).all()
    rounding = 1e-6 * num_agents * float(np.abs(cost).max())
    landmarks = np.asarray(assign_one(cost))
    assert total(cost, landmarks) == pytest.approx(optimum(cost), rel=1e-5, abs=rounding)


@pytest.mark.parametrize("shape", [(3, 4), (7, 6)], ids=str)
def test_any_float_gives_a_valid_answer(shape: tuple[int, int]):
    @settings(max_examples=150, deadline=None, derandomize=True, database=None)
    @given(hnp.arrays(np.float32, shape, elements=st.floats(width=32, allow_subnormal=False)))
    def check(cost: np.ndarray):
        landmarks = np.asarray(assign_one(cost))
        check_valid(landmarks, shape[1])
        if np.isfinite(cost).all():
            # float32's share of the largest cost is all that can be asked of values that differ so much.
            rounding = 1e-5 * float(np.abs(cost).max())
            assert total(cost, landmarks) <= optimum(cost) + rounding

    check()


@pytest.mark.parametrize("forbidden", [np.inf, -np.inf, np.nan])
@pytest.mark.parametrize(("real", "padded"), [(2, 4), (30, 40)])
def test_forbidden_pairs_mask_padding(real: int, padded: int, forbidden: float):
    inner = distances(1, 1, real, real)[0]
    cost = np.full((padded, padded), forbidden, np.float32)
    cost[:real, :real] = inner
    landmarks = np.asarray(assign_one(cost))
    check_valid(landmarks, padded)
    assert total(inner, landmarks[:real]) == pytest.approx(optimum(inner), rel=1e-4)


@pytest.mark.parametrize("num_agents", [4, 40])
def test_forbidden_pairs_are_avoided_whatever_it_costs(num_agents: int):
    # Each agent may take its own landmark for 1 or the next for 0; the last has no next.
    cost = np.where(np.eye(num_agents, k=1, dtype=bool), 0.0, np.inf).astype(np.float32)
    np.fill_diagonal(cost, 1.0)
    np.testing.assert_array_equal(assign_one(cost), np.arange(num_agents))
    # Without its own, the first starts the chain, and the last has to break the rule, but nobody else.
    cost[0, 0] = np.nan
    np.testing.assert_array_equal(assign_one(cost), np.roll(np.arange(num_agents), -1))


@pytest.mark.parametrize("shape", [(3, 4), (7, 6)], ids=str)
def test_batched_and_compiled_equal_one_at_a_time(shape: tuple[int, int]):
    costs = distances(2, 6, *shape)
    one_at_a_time = np.stack([assign_one(cost) for cost in costs])
    np.testing.assert_array_equal(assign_many(costs), one_at_a_time)


@pytest.mark.parametrize("shape", [(3, 4), (7, 6)], ids=str)
def test_renaming_agents_and_landmarks_renames_the_answer(shape: tuple[int, int]):
    rng = np.random.default_rng(3)
    cost = distances(3, 1, *shape)[0]
    agents, landmarks = rng.permutation(shape[0]), rng.permutation(shape[1])
    original = np.asarray(assign_one(cost))
    renamed = np.asarray(assign_one(cost[agents][:, landmarks]))
    np.testing.assert_array_equal(np.where(renamed < 0, -1, landmarks[renamed]), original[agents])


def test_gradient_passes_by():
    """The chosen costs can be differentiated; the choice itself is a constant."""
    cost = jnp.asarray(distances(4, 1, 40, 40)[0])

    def chosen(cost: jax.Array) -> jax.Array:
        return cost[jnp.arange(40), assign(cost)].sum()

    np.testing.assert_array_equal(jax.jit(jax.grad(chosen))(cost), jax.nn.one_hot(assign_one(cost), 40))


@pytest.mark.parametrize("shape", [(3, 3), (12, 9)], ids=str)
def test_double_precision(shape: tuple[int, int]):
    cost = np.random.default_rng(5).normal(size=shape)
    with jax.enable_x64(True):
        landmarks = np.asarray(assign_one(jnp.asarray(cost)))
    assert total(cost, landmarks) == pytest.approx(optimum(cost), rel=1e-12)


@pytest.mark.parametrize("shape", [(0, 3), (3, 0)], ids=str)
def test_empty_teams_are_refused(shape: tuple[int, int]):
    with pytest.raises(ValueError, match="N, L >= 1"):
        assign(jnp.zeros(shape))
