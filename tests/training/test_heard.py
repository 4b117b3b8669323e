"""What agents heard when they acted is what is learned from, where `training.intervention` changes what arrives."""

import contextlib
import io
import json
import signal
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import drawn_learner, soaked

from gacrl import rollout
from gacrl.algorithms import actions, gacrl_paper, q_learning, q_loss
from gacrl.algorithms import build as algorithms
from gacrl.algorithms import replay as ring
from gacrl.algorithms.contract import Algorithm
from gacrl.cli.main import main
from gacrl.config import presets
from gacrl.config.algorithms import DialConfig, GacrlPaperConfig, MappoConfig, NetworkConfig
from gacrl.config.run import RunConfig, TrainingConfig
from gacrl.errors import ConfigError
from gacrl.evaluation.evaluate import evaluate, stream_key
from gacrl.messages import interventions
from gacrl.tasks.spread.environment import Spread
from gacrl.tasks.spread.settings import SpreadSettings
from gacrl.training import build, checkpoint
from gacrl.training.curriculum import constant
from gacrl.training.recorder import RunFolder
from gacrl.training.trainer import Trainer
from gacrl.types import Arrives, Rollout

pytestmark = pytest.mark.xdist_group("heard")

N, E, T = 3, 4, 6
EVERY = ("silence 1", "swap 0 2", "scramble", "drop 0.4", "delay 2", "noise 0.5")
SETTINGS = SpreadSettings(num_agents=N, num_landmarks=2, max_cycles=4)
ENV = Spread(N, 2, max_cycles=4)
SYMBOLS = NetworkConfig(width=8, depth=1, communication="discrete", vocabulary=4, rounds=2)
DIAL = replace(SYMBOLS, communication="dial", recurrent=True, dial_noise=0.5)
COMMNET = replace(SYMBOLS, communication="commnet", recurrent=True)


def trained_with(text: str, algorithm: Any, **training: Any) -> RunConfig:
    """A run of that intervention on a small task."""
    training = {"env_steps": 1_000, "num_envs": E, "num_steps": T, **training}
    return RunConfig(algorithm=algorithm, env=SETTINGS, training=TrainingConfig(intervention=text, **training))


def gathered(trainer: Trainer, learner: Any, explore: bool = True) -> Rollout:
    """A rollout that begins in the middle of episodes, after two steps, and has their end in it."""

    @jax.jit
    def collect(learner: Any) -> Rollout:
        policy, params = trainer.algorithm.policy(learner, explore), trainer.env.default_params()
        played = (trainer.env, policy, trainer.memory, params)
        key = jax.random.key(0)
        start = rollout.start(*played[:1], params, trainer.memory, key, E, trainer.intervention, policy)
        under_way, _ = rollout.collect(*played, start, jax.random.key(1), 2, trainer.intervention)
        return rollout.collect(*played, under_way, jax.random.key(2), T, trainer.intervention)[1]

    return collect(learner)


def unheard(experience: Rollout) -> Rollout:
    """The same, as if everything had arrived as it was said."""
    steps = experience.transitions
    seen, after = (it._replace(arrives=Arrives()) for it in (steps.observation, steps.next_observation))
    return experience._replace(transitions=steps._replace(observation=seen, next_observation=after))


# The setting reaches what acts, what is learned from, and what is evaluated.


@pytest.mark.parametrize("text", soaked(EVERY, "scramble", "delay 2"))
def test_the_setting_is_what_happens_in_training_and_in_its_evaluations(text: str):
    trainer = build.make_trainer(trained_with(text, MappoConfig(network=SYMBOLS)))
    assert trainer.intervention is not None and trainer.intervention.name == text.split()[0]
    states = trainer.init((0,))
    found = trainer.evaluate(states.learner, False, "monitor", 8)["return_agent_mean"]
    learner = jax.tree.map(lambda leaf: leaf[0], states.learner)
    policy = trainer.algorithm.policy(learner, False)
    arguments = (ENV, policy, trainer.memory, trainer.evaluation_params, stream_key("monitor"), 8)
    expected = jax.jit(lambda: evaluate(*arguments, interventions.parse(text)))()["return_agent_mean"]
    np.testing.assert_allclose(found[0], expected, rtol=1e-6)


# PPO.


class Talk(NamedTuple):
    network: NetworkConfig
    text: str


TALKS = {
    **{f"discrete, {text}": Talk(SYMBOLS, text) for text in EVERY},
    "commnet, recurrent, drop 0.4": Talk(COMMNET, "drop 0.4"),
    "gated, noise 0.5": Talk(replace(SYMBOLS, gate=True), "noise 0.5"),
    "ic3net, swap 0 2": Talk(replace(SYMBOLS, communication="ic3net"), "swap 0 2"),
    "tarmac, scramble": Talk(replace(SYMBOLS, communication="tarmac"), "scramble"),
    "told, recurrent, delay 2": Talk(replace(SYMBOLS, communication="told", recurrent=True), "delay 2"),
    "dial, recurrent, delay 2": Talk(DIAL, "delay 2"),
    "dial, recurrent, swap 0 2": Talk(DIAL, "swap 0 2"),
}


@pytest.mark.parametrize(
    "name", soaked(TALKS, "discrete, delay 2", "discrete, drop 0.4", slow=["gated, noise 0.5"])
)
def test_the_first_ratio_of_ppo_is_one_whatever_arrives(name: str):
    """The agents' words are drawn. Without what arrived, the ratio is another one."""
    network, text = TALKS[name]
    config = MappoConfig(network=network, update_epochs=1, num_minibatches=1, clip_eps=1e-5)
    trainer = build.make_trainer(trained_with(text, config))
    learner, update = drawn_learner(trainer.algorithm), jax.jit(trainer.algorithm.update)
    experience = gathered(trainer, learner)
    assert experience.transitions.truncated.any()
    _, metrics = update(learner, experience, jax.random.key(3))
    assert metrics["ratio_clipped"] == 0.0 and abs(metrics["kl"]) < 1e-6
    _, metrics = update(learner, unheard(experience), jax.random.key(3))
    assert metrics["ratio_clipped"] > 0.2


# Q-learning.

GACRL = replace(
    presets.preset("gacrl").algorithm,
    network=replace(SYMBOLS, torso="graph", latent="deterministic", latent_size=3),
    augment=False,
    symmetric_play=False,
    averaged=False,
    replay_capacity=240,
    learning_starts=0,
    batch_size=8,
    updates=2,
)
LEARNERS = {
    "gacrl": GACRL,
    "gacrl, recurrent": replace(GACRL, network=replace(GACRL.network, recurrent=True), sequence_length=3),
    "dial": DialConfig(
        network=DIAL, sequence_length=3, n_step=2, replay_capacity=240, learning_starts=0, batch_size=8, updates=2
    ),
}


def setup_of(algorithm: Algorithm) -> Any:
    """The constants of a learner's functions."""
    assert isinstance(algorithm.init, partial)
    return algorithm.init.args[0]


REPLAYED = [
    *(("gacrl", text) for text in EVERY),
    *(("gacrl, recurrent", text) for text in ("silence 1", "delay 2")),
    *(("dial", text) for text in ("swap 0 2", "drop 0.4", "delay 2")),
]


@pytest.mark.parametrize(
    ("name", "text"),
    soaked(REPLAYED, ("gacrl", "swap 0 2"), ("gacrl, recurrent", "delay 2"), slow=[("dial", "drop 0.4")]),
)
def test_the_replay_of_q_learning_holds_what_arrived_and_windows_hear_it(name: str, text: str):
    """Windows that are read back say the values that the agents acted on; nothing is drawn here."""
    trainer = build.make_trainer(trained_with(text, LEARNERS[name]))
    learner = drawn_learner(trainer.algorithm)
    experience = gathered(trainer, learner, explore=False)
    after, metrics = jax.jit(trainer.algorithm.update)(learner, experience, jax.random.key(3))
    assert np.isfinite(metrics["loss_td"]) and int(after.replay.added) == T
    q, steps = setup_of(trainer.algorithm), experience.transitions
    unpack = ring.packing(partial(q_learning.example, q))[1]
    stored = jax.vmap(jax.vmap(unpack))(after.replay.items[:T])
    for part in ("observation", "next_observation"):
        found, arrived = (getattr(it, part).arrives for it in (stored.transition, steps))
        assert jax.tree.structure(found) == jax.tree.structure(arrived)
        for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(arrived), strict=True):
            assert one.dtype == other.dtype
            np.testing.assert_array_equal(one, other)

    @jax.jit
    def values(stored: Any) -> Any:
        first = jax.tree.map(lambda leaf: leaf[0], stored.memory)
        temperature = q.explorer.level(learner.exploration, learner.env_steps).temperature
        output, _ = q_loss.along(learner.network.agent, stored.transition, first, None, temperature)

        def value(output: Any, seen: Any) -> Any:
            best = actions.greedy(output.head, q.actions.mask(seen.action_mask))
            return q.parts.team_value(learner.network, output, best, seen).mean()

        return jax.vmap(jax.vmap(value))(output, stored.transition.observation)

    acted = steps.decision.extras["value"][..., 0]
    np.testing.assert_allclose(values(stored), acted, rtol=1e-4, atol=1e-5)
    forgotten = stored.transition._replace(observation=stored.transition.observation._replace(arrives=Arrives()))
    assert np.abs(values(stored._replace(transition=forgotten)) - acted).max() > 1e-3


@dataclass(frozen=True)
class Deaf(Spread):
    """The same task, whose own graph has no edge."""

    def observe(self, state: Any, params: Any) -> Any:
        graph = jnp.zeros((self.num_agents, self.num_agents, *state.clock.shape), bool)
        return super().observe(state, params)._replace(adjacency=graph)


SILENCED = {
    **LEARNERS,
    "gacrl, turned": replace(GACRL, augment=True, symmetric_play=True),
    "mappo": MappoConfig(network=SYMBOLS, update_epochs=2, num_minibatches=2),
}


@pytest.mark.parametrize("name", soaked(SILENCED, "gacrl", slow=["mappo"]))
def test_to_train_in_silence_is_to_train_where_no_edge_is(name: str):
    """Six updates: the same weights and metrics. With words they are others."""

    def trained(env: Spread, text: str) -> Any:
        training = TrainingConfig(env_steps=1_000, num_envs=E, num_steps=T, intervention=text)
        algorithm = algorithms.make(SILENCED[name], env, training, "coverage_0.2")
        trainer = Trainer(algorithm, env, constant(), E, T, intervention=interventions.parse(text))
        state, report = trainer.chunk(trainer.init((0,)), 6)
        return state.learner.network, report.metrics, report.episodes

    silent, deaf = trained(ENV, "silence"), trained(Deaf(N, 2, max_cycles=4), "")
    for found, expected in zip(jax.tree.leaves(silent), jax.tree.leaves(deaf), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)
    talking = trained(ENV, "")
    apart = [np.abs(a - b).max() for a, b in zip(*map(jax.tree.leaves, (silent[0], talking[0])), strict=True)]
    assert max(apart) > 1e-3


# The paper's algorithm.

PAPER = GacrlPaperConfig(batch_size=5, replay_capacity=100, epsilon=0.0, epsilon_end=0.0, epsilon_bonus=0.0)


@pytest.mark.parametrize("text", soaked(EVERY, "delay 2"))
def test_the_papers_loss_is_of_the_logits_that_were_acted_on(text: str):
    """The replay's rows and the noise of acting give the words, the actions and the log-probabilities of acting."""
    trainer = build.make_trainer(trained_with(text, PAPER))
    learner = drawn_learner(trainer.algorithm)
    experience = gathered(trainer, learner)
    p, steps, decision = setup_of(trainer.algorithm), experience.transitions, experience.transitions.decision
    after, _ = jax.jit(trainer.algorithm.update)(learner, experience, jax.random.key(3))
    rows = jax.vmap(ring.packing(partial(gacrl_paper.no_experience, p))[1])(after.replay.items[: T * E])
    flat = lambda leaf: np.asarray(leaf).reshape(T * E, *leaf.shape[2:])  # noqa: E731
    arrived, noise = jax.tree.map(flat, (steps.observation.arrives, decision.extras["noise"]))
    jax.tree.map(np.testing.assert_array_equal, rows.arrives, arrived)
    _, temperature = gacrl_paper.levels(p, learner)

    @partial(jax.jit, static_argnums=2)
    def of(rows: Any, noise: Any, drawn: bool) -> Any:
        def one(row: Any, noise: Any) -> Any:
            noise = noise if drawn else None
            return gacrl_paper.forward(
                learner.network, row.features, row.adjacency, temperature, noise, False, row.arrives
            )

        return jax.vmap(one)(rows, noise)

    found = of(rows, noise, True)
    np.testing.assert_allclose(np.moveaxis(found.messages, 2, 3), flat(decision.messages), rtol=1e-5, atol=1e-6)
    keys = jax.vmap(lambda key: jax.random.split(key, (E, 3))[:, 0])(jax.random.split(jax.random.key(2), T))
    drawn = jax.vmap(jax.vmap(lambda key: gacrl_paper.draw_noise(key, N, 5, PAPER)))(keys)
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-5), jax.tree.map(flat, drawn[0]), noise)

    def acted(found: Any) -> np.ndarray:
        log_policy = jax.nn.log_softmax(jnp.moveaxis(found.logits, 1, 2))
        return np.asarray((log_policy + flat(drawn[1])).argmax(-1))

    np.testing.assert_array_equal(acted(found), flat(decision.action))
    greedy = jax.jit(
        jax.vmap(lambda seen: trainer.algorithm.policy(learner, False)((), seen, jax.random.key(0))[0])
    )
    played = greedy(jax.tree.map(lambda leaf: jnp.asarray(flat(leaf)), steps.observation))
    plain = of(rows, noise, False)
    np.testing.assert_array_equal(played.action, plain.logits.argmax(1))

    some = 5 + 1  # replayed, and the current one
    few = jax.tree.map(lambda leaf: leaf[:some], rows)
    columns = gacrl_paper.Noise(*(jnp.moveaxis(jnp.asarray(leaf[:some]), 0, -1) for leaf in noise))
    loss = jax.jit(
        lambda rows: gacrl_paper.loss(learner.network, learner.hyper, rows, temperature, columns, PAPER)
    )
    log_pi = gacrl_paper.log_probability(jnp.moveaxis(found.logits[:some], 0, -1), few.action.T)
    expected = gacrl_paper.policy_loss(log_pi, few.reward, 5)
    np.testing.assert_allclose(loss(few)[1]["loss_policy"], expected, rtol=1e-5)
    deaf = loss(few._replace(arrives=Arrives()))[1]["loss_policy"]
    assert abs(deaf - expected) > 1e-4 * abs(expected)


# Whole runs.

SHORT = [
    *("--preset", "gacrl", "--env-steps", "200", "--evaluation.interval", "50", "--seed", "3"),
    *("--training.num-envs", "5", "--env.max-cycles", "10", "--algorithm.network.width", "4"),
    *("--algorithm.replay-capacity", "100", "--algorithm.learning-starts", "20", "--algorithm.batch-size", "4"),
    *("--algorithm.updates", "1", "--evaluation.num-episodes", "2", "--evaluation.final-episodes", "2"),
]


@pytest.mark.soak
def test_a_run_with_words_on_their_way_resumes_with_the_same_bits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Interrupted in the middle of episodes: what was said before and has not arrived is in the checkpoint."""
    words = ["train", *SHORT, "--training.intervention", "delay 3"]
    whole, parted = tmp_path / "whole", tmp_path / "parted"
    real = RunFolder.append_metrics

    def interrupted(self: RunFolder, rows: list[dict[str, Any]]) -> None:
        if rows[0]["env_steps"] == 100:
            signal.raise_signal(signal.SIGINT)
        real(self, rows)

    with contextlib.redirect_stdout(io.StringIO()):
        assert main([*words, "--out", str(whole)]) == 0
        with monkeypatch.context() as patch:
            patch.setattr(RunFolder, "append_metrics", interrupted)
            assert main([*words, "--out", str(parted)]) == 130
        assert checkpoint.newest(parted / "checkpoints")[0].env_steps == 100
        assert main(["resume", str(parted)]) == 0
    states = [
        (folder / "checkpoints/step-000000000200/state.safetensors").read_bytes() for folder in (whole, parted)
    ]
    assert states[0] == states[1]
    assert json.loads((parted / "config.json").read_text())["training"]["intervention"] == "delay 3"
    finals = [json.loads((folder / "summary.json").read_text())["final"] for folder in (whole, parted)]
    assert finals[0] == finals[1]


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--preset", "gacrl", "drop 2"], "drop must be a probability between 0 and 1, not 2.0"),
        (["--preset", "gacrl", "hush"], "unknown intervention 'hush'"),
        (["--preset", "gacrl", "silence 3"], "silence: there are the agents 0 to 2"),
        (["--preset", "paper", "swap 0 4"], "swap: there are the agents 0 to 2"),
        (["--preset", "paper", "scramble"], "to scramble messages takes at least two episodes side by side"),
        (["--preset", "ippo", "silence"], "the agents say nothing: there are no messages to"),
        (["--preset", "vdn", "delay 2"], "the agents say nothing: there are no messages to"),
    ],
)
def test_a_setting_that_does_not_fit_ends_with_one_sentence(
    words: list[str], sentence: str, said: Callable[..., tuple[int, str]], tmp_path: Path
):
    out = tmp_path / "run"
    code, error = said("train", *words[:-1], "--training.intervention", words[-1], "--out", out)
    assert code == 2 and error.startswith(f"gacrl: {sentence}") and error.count("\n") == 1
    assert not out.exists()


def test_a_learner_that_replays_needs_words_too():
    silent = replace(GACRL, network=replace(GACRL.network, communication="none"))
    with pytest.raises(ConfigError, match="the agents say nothing: there are no messages to swap"):
        build.make_trainer(trained_with("swap 0 1", silent))
