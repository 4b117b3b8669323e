"""marl-eval's raw data, out and in."""

import json

import pytest

from gacrl.errors import UserError
from gacrl.experiments.compare.marl_eval import EvaluatedRun, from_marl_eval, to_marl_eval

RUN = EvaluatedRun(
    environment="spread",
    task="3_agents",
    algorithm="vdn",
    run="seed_0",
    env_steps=[100, 200],
    metrics={"return": [[-26.0, -24.0], [-20.0, -18.0]]},
    absolute={"return": [-19.0]},
)


def test_marl_eval_out_and_in():
    data = to_marl_eval([RUN])
    assert data == {
        "spread": {
            "3_agents": {
                "vdn": {
                    "seed_0": {
                        "step_0": {"step_count": 100, "return": [-26.0, -24.0]},
                        "step_1": {"step_count": 200, "return": [-20.0, -18.0]},
                        "absolute_metrics": {"return": [-19.0]},
                    }
                }
            }
        }
    }
    assert from_marl_eval(json.loads(json.dumps(data))) == [RUN]


def test_marl_eval_steps_are_ordered_by_count():
    run = {"step_10": {"step_count": 9, "x": [2]}, "step_9": {"step_count": 3, "elapsed_time": 1.5, "x": [1]}}
    (found,) = from_marl_eval({"e": {"t": {"a": {"r": run}}}})
    assert found.env_steps == [3, 9]
    assert found.metrics == {"x": [[1.0], [2.0]]}
    assert found.absolute == {}


def test_marl_eval_refuses_what_it_is_not():
    with pytest.raises(UserError, match="seed_0 of vdn on 3_agents is there twice"):
        to_marl_eval([RUN, RUN])
    for data in ({"e": 3}, {"e": {"t": {"a": {"r": {"step_0": {"x": [1]}}}}}}):
        with pytest.raises(UserError, match="not marl-eval's raw data"):
            from_marl_eval(data)
