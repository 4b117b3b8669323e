"""What the paper's algorithm learns on tiny tasks with known answers, all of them in one compiled program."""

import pytest

from gacrl import config
from gacrl.doctor import BEYOND, PROBE_UPDATES
from gacrl.envs.probes import BEST_RETURN, PROBES
from gacrl.training.probing import probe_algorithm


@pytest.mark.xdist_group("readme")  # shares the compiled probes with `gacrl doctor`
def test_what_the_paper_learns_and_what_it_cannot(quick_start):
    result = probe_algorithm(config.preset("paper").algorithm, PROBE_UPDATES)
    assert set(result.returns) == set(PROBES)
    for probe, best in BEST_RETURN.items():
        if probe not in BEYOND["gacrl_paper"]:
            assert result.returns[probe] == pytest.approx(best)
    assert result.values["value"] == pytest.approx((1.0, 1.0), abs=0.05)
    assert result.values["observation"] == pytest.approx((-1.0, 1.0), abs=0.05)
    # Equation (19) regresses the immediate reward: of the reward a step later it knows nothing.
    assert result.values["discount"] == pytest.approx((0.0, 0.0), abs=0.05)
    # Equation (20) without a reconstruction empties the latent, and messages are made of nothing else.
    assert result.returns["message"] < 0.9
