"""What the paper's algorithm learns on tasks with known answers, and what its printed KL weight keeps it from."""

from dataclasses import replace

import pytest

from gacrl.config import GacrlPaperConfig
from gacrl.envs.probes import BEST_RETURN
from gacrl.training.probing import ProbeResult, probe_algorithm

pytestmark = [pytest.mark.usefixtures("quick_start"), pytest.mark.xdist_group("probing")]

UPDATES, SEED = 4_000, 2


@pytest.fixture(scope="module")
def printed(quick_start: dict[str, str]) -> ProbeResult:
    return probe_algorithm(GacrlPaperConfig(), UPDATES, seed=SEED)


@pytest.mark.parametrize("probe", ["action", "both"])
def test_it_learns_to_act(probe: str, printed: ProbeResult):
    assert printed.returns[probe] == BEST_RETURN[probe] == 1.0


def test_the_critic_regresses_the_immediate_reward(printed: ProbeResult):
    """Equation (19). Of a reward that comes a step later it therefore expects nothing at the first step."""
    assert printed.values["value"] == pytest.approx((1.0, 1.0), abs=0.05)
    assert printed.values["observation"] == pytest.approx((-1.0, 1.0), abs=0.05)
    assert printed.returns["discount"] == 1.0
    assert printed.values["discount"] == pytest.approx((0.0, 0.0), abs=0.05)


def test_the_printed_kl_weight_silences_the_messages(printed: ProbeResult):
    """Messages are made from the latent alone. Before anybody listens, nothing but the KL term acts on it, and with
    the printed weight it forgets the observation for good; without the term the same seed learns to talk.
    """
    assert abs(printed.returns["message"]) < 0.5
    talking = probe_algorithm(replace(GacrlPaperConfig(), kl_weight=0.0), UPDATES, seed=SEED)
    assert talking.returns["message"] == BEST_RETURN["message"] == 1.0


def test_acting_at_random_brings_nothing(quick_start: dict[str, str]):
    """After a single update the policy is still that of its initial weights: greedy, and no better than chance."""
    untrained = probe_algorithm(GacrlPaperConfig(), 1, seed=SEED)
    assert abs(untrained.returns["both"]) < 0.5
    assert abs(untrained.returns["message"]) < 0.5
    assert abs(untrained.values["value"][0] - 1.0) > 0.5
