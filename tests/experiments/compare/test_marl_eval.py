"""marl-eval's raw data."""

import pytest

from gacrl.errors import UserError
from gacrl.experiments.compare.marl_eval import EvaluatedRun, to_marl_eval

RUN = EvaluatedRun(
    environment="spread",
    task="3_agents",
    algorithm="vdn",
    run="seed_0",
    env_steps=[100, 200],
    metrics={"return": [[-26.0, -24.0], [-20.0, -18.0]]},
    absolute={"return": [-19.0]},
)


def test_marl_eval_by_hand():
    assert to_marl_eval([RUN]) == {
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


def test_marl_eval_refuses_a_run_that_is_there_twice():
    with pytest.raises(UserError, match="seed_0 of vdn on 3_agents is there twice"):
        to_marl_eval([RUN, RUN])
