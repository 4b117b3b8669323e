"""From measurements to metrics, by hand: which there are, and how steps become an episode."""

import jax.numpy as jnp
import numpy as np
import pytest

from gacrl.envs.probes import Probe
from gacrl.evaluation.metrics import (
    Table,
    count_step,
    count_step_if,
    episode_metrics,
    measures_of,
    no_episodes,
    no_steps,
    sum_up,
    table_of,
)
from gacrl.tasks.spread.environment import Spread
from gacrl.tasks.spread.settings import METRICS
from gacrl.tasks.task import RETURN, Metric

SERVED = {
    "served": Metric("served", "last"),
    "served_mean": Metric("served", "mean"),
    "waited": Metric("waiting", "sum", "minutes", False),
    "unmeasured": Metric("nowhere", "sum"),
}
MEASURES = ["waiting", "served", "reward_raw", "speed"]


def test_an_episode_has_the_metrics_of_its_task_the_return_and_what_else_is_measured():
    """Of a measure without a metric the mean; a metric without its measure there is not."""
    table = table_of(MEASURES, SERVED)
    assert table.measures == ("reward_raw", "served", "speed", "waiting")
    assert table.names == ("served", "served_mean", "waited", "return_agent_mean", "reward_raw", "speed")
    assert dict(table.metrics)["speed"] == Metric("speed", "mean")
    assert dict(table.metrics)["return_agent_mean"] == RETURN["return_agent_mean"]
    # The order in which a step names its measurements does not matter.
    assert table_of(MEASURES[::-1], SERVED) == table
    assert table_of(["reward_raw"], RETURN).names == ("return_agent_mean", "reward_raw")
    # A task may say otherwise what its return is.
    own = {"return_agent_mean": Metric("reward_raw", "last")}
    assert dict(table_of(["reward_raw"], own).metrics)["return_agent_mean"].over == "last"


def test_steps_are_summed_meant_and_the_last_is_kept():
    table = table_of(MEASURES, SERVED)
    tally = no_steps(table)
    for served, waiting, reward, speed in ((0.0, 3.0, -1.0, 10.0), (0.5, 1.0, -2.0, 20.0), (0.25, 0.0, 0.0, 60.0)):
        info = {"waiting": waiting, "served": served, "reward_raw": reward, "speed": speed}
        tally = count_step(tally, {name: jnp.asarray(value) for name, value in info.items()})
    found = dict(zip(table.names, np.asarray(episode_metrics(tally, table)).tolist(), strict=True))
    assert found == pytest.approx(
        {
            "served": 0.25,
            "served_mean": 0.25,
            "waited": 4.0,
            "return_agent_mean": -3.0,
            "reward_raw": -1.0,
            "speed": 30.0,
        }
    )
    after = count_step_if(jnp.asarray(False), tally, {name: jnp.asarray(99.0) for name in MEASURES})
    np.testing.assert_array_equal(episode_metrics(after, table), episode_metrics(tally, table))
    assert int(after.steps) == 3


def test_of_no_steps_everything_is_nothing():
    table = table_of(MEASURES, SERVED)
    np.testing.assert_array_equal(episode_metrics(no_steps(table), table), np.zeros(6))
    nothing = no_episodes(table)
    assert int(nothing.ended) == 0
    np.testing.assert_array_equal(nothing.total, np.zeros(6))


def test_episodes_that_ended_are_summed_up_by_hand():
    """Three steps of two environments, two numbers an episode; three of them end, two at the last of those times."""
    done = jnp.array([[True, False], [True, True], [False, False]])
    episodes = jnp.array([[[1.0, 10.0], [9.0, 9.0]], [[2.0, 20.0], [4.0, 40.0]], [[8.0, 8.0], [8.0, 8.0]]])
    found = sum_up(episodes, done)
    assert int(found.ended) == 3
    np.testing.assert_array_equal(found.total, [7.0, 70.0])
    np.testing.assert_array_equal(found.squares, [1 + 4 + 16, 100 + 400 + 1600])
    np.testing.assert_array_equal(found.last, [2.0, 20.0])


def test_what_tasks_measure_is_known_before_they_are_played():
    assert measures_of(Probe(), Probe().default_params()) == ["reward_raw"]
    for env in (Spread(), Spread(continuous_actions=True)):
        table: Table = table_of(measures_of(env, env.default_params()), METRICS)
        assert set(table.names) == set(METRICS), "spread has a metric for everything that it measures"
        assert {metric.measure for _, metric in table.metrics} == set(table.measures)
