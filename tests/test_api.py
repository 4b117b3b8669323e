"""What `import gacrl` offers: a run of a policy written by hand, whose numbers are known, and every misuse a sentence.

The policy talks: one agent says what it sees, and whoever hears it earns 1 a step; unheard, it guesses.
"""

import contextlib
import io
import json
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_play import untrained

import gacrl
from gacrl import Environment, TimeStep, observe, tasks
from gacrl.config import presets
from gacrl.config.algorithms import ALGORITHMS, Kind
from gacrl.config.files import from_dict, to_dict
from gacrl.evaluation.evaluate import stream_key
from gacrl.networks.arrives import arriving
from gacrl.networks.graph import heard_adjacency
from gacrl.types import Decision

pytestmark = pytest.mark.xdist_group("api")

STEPS, EPISODES = 4, 8


@dataclass(frozen=True)
class Whisper(Environment):
    """The first agent sees a sign; the others earn 1, for all, in a step in which each of them acts by it."""

    num_agents: int = 2
    num_actions: int = 2
    observation_size: int = 3
    max_cycles: int = STEPS

    def reset(self, key: Any, params: Any = ()) -> Any:
        return self.draw(key, jnp.zeros((), jnp.int32))

    def step(self, state: Any, action: Any, key: Any, params: Any = ()) -> Any:
        right = (action[1:] == (state["sign"] > 0)).all().astype(float)
        state, seen = self.draw(key, state["clock"] + 1)
        over = state["clock"] >= self.max_cycles
        return state, TimeStep(seen, jnp.full(self.num_agents, right), jnp.asarray(False), over)

    def draw(self, key: Any, clock: Any) -> Any:
        sign, chance = jax.random.rademacher(key, ()) * 1.0, jax.random.uniform(jax.random.fold_in(key, 1))
        first = jnp.arange(self.num_agents) == 0
        numbers = jnp.stack([sign * first, first * 1.0, jnp.broadcast_to(chance, first.shape)], axis=1)
        return {"sign": sign, "clock": clock}, observe(numbers, num_actions=2)


class Guess(NamedTuple):
    """Of a seed: how often the unheard act, and what training has earned."""

    share: jax.Array
    earned: jax.Array


@dataclass(frozen=True)
class EchoConfig:
    """A policy by hand: nothing is learned, but what was earned is counted."""

    name: ClassVar[str] = "echo"
    gain: float = 1.0


def make_echo(config: EchoConfig, env: Environment, training: Any, progress: Any = None) -> gacrl.Algorithm:
    def policy(learner: Guess, explore: bool) -> Any:
        def act(memory: Any, observation: Any, key: Any) -> Any:
            sign, chance = observation.features[:, 0], observation.features[:, 2]
            hears = heard_adjacency(observation, 1.0)
            heard = (hears * arriving(config.gain * sign[:, None], observation.arrives)[None, :, 0]).sum(1)
            action = jnp.where(heard != 0, heard > 0, chance < learner.share).astype(jnp.int32)
            if explore:
                action = jnp.where(jax.random.uniform(key, action.shape) < 0.5, 0, action)
            return Decision(action, config.gain * sign[None, :, None], hears), memory

        return act

    def update(learner: Guess, rollout: Any, key: Any) -> Any:
        reward = rollout.transitions.reward.mean()
        return learner._replace(earned=learner.earned + reward), {"loss": reward}

    return gacrl.Algorithm(
        init=lambda key, hyper: Guess(jax.random.uniform(key, (), minval=0.2, maxval=0.8), jnp.zeros(())),
        initial_memory=lambda num_agents: (),
        policy=policy,
        update=update,
        hyper=(),
    )


@pytest.fixture(scope="module", autouse=True)
def at_hand() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tasks, "_OWN", {})
        patch.setitem(ALGORITHMS, "echo", Kind(EchoConfig, make_echo))
        yield


@pytest.fixture(scope="module")
def config(at_hand: None) -> gacrl.RunConfig:
    """Two seeds, four chunks of two updates of sixteen steps."""
    changes = {
        "training.env_steps": 128,
        "training.num_envs": 4,
        "training.num_steps": 4,
        "evaluation.interval": 32,
    }
    tiny = gacrl.preset(
        "ippo", **changes, **{"evaluation.num_episodes": EPISODES, "evaluation.final_episodes": 32}
    )
    return replace(tiny, algorithm=EchoConfig(), num_seeds=2, seed=3)


class Trained(NamedTuple):
    run: gacrl.Run
    said: str
    """What was printed."""
    heard: list[Any]
    """What both watchers were told."""


@pytest.fixture(scope="module")
def trained(config: gacrl.RunConfig, tmp_path_factory: pytest.TempPathFactory) -> Trained:
    """A run under two watchers, and what was said meanwhile."""
    heard: list[Any] = []
    one = gacrl.Watcher(progress=lambda progress: heard.append(("one", progress.env_steps)))
    other = gacrl.Watcher(
        progress=lambda progress: heard.append(("other", progress.env_steps)),
        finished=lambda summary: heard.append(summary),
    )
    folder = tmp_path_factory.mktemp("api") / "run"
    with contextlib.redirect_stderr(io.StringIO()) as said, contextlib.redirect_stdout(said):
        run = gacrl.train(config, env=Whisper(), out=folder, watcher=one + other)
    return Trained(run, said.getvalue(), heard)


@pytest.fixture
def run(trained: Trained) -> gacrl.Run:
    return trained.run


# A run, and what it says.


def test_training_says_where_it_stands_in_whole_lines(trained: Trained):
    """No cursor is moved: a notebook and a log show the lines as a terminal does."""
    assert not re.search(r"[\r\x1b\x08]", trained.said)
    lines = trained.said.splitlines()
    assert [re.match(r"step (\d+) of 128\b", line)[1] for line in lines if line.startswith("step")] == [
        *("32", "64", "96", "128")
    ]
    assert lines[0].startswith(f"{trained.run.folder}: echo on Whisper")
    assert lines[-1].startswith("done")


def test_a_quiet_run_says_nothing(config: gacrl.RunConfig, tmp_path: Path, capfd: pytest.CaptureFixture[str]):
    short = replace(config, training=replace(config.training, env_steps=16), num_seeds=1)
    gacrl.train(short, env=Whisper(), out=tmp_path / "run", quiet=True, track=["csv"])
    assert capfd.readouterr() == ("", "")


def test_watchers_add_up_and_hear_the_closing_summary(trained: Trained):
    steps = [(name, step) for step in (32, 64, 96, 128) for name in ("one", "other")]
    assert trained.heard == [*steps, trained.run.summary]
    stopped = gacrl.Watcher(stop=lambda: True) + gacrl.Watcher()
    assert stopped.stop() and not (gacrl.Watcher() + gacrl.Watcher()).stop()


def test_a_run_has_its_metrics_and_its_summary(run: gacrl.Run):
    """The greedy policy is heard, so that each of four steps earns 1."""
    np.testing.assert_array_equal(run.metrics["env_steps"], [32, 64, 96, 128])
    np.testing.assert_array_equal(run.metrics["return_agent_mean"], np.full((2, 4), 4.0))
    assert run.summary == json.loads((run.folder / "summary.json").read_text())
    assert run.summary["final"]["greedy"]["return_agent_mean"]["mean"] == 4.0
    assert repr(run).splitlines() == [
        f"Run {run.folder}",
        "  echo on Whisper, seeds 3, 4, 128 environment steps",
        "  return 4",
    ]


def test_a_run_that_was_stopped_says_how_to_go_on(config: gacrl.RunConfig, tmp_path: Path):
    stopped = gacrl.train(
        config, env=Whisper(), out=tmp_path / "run", watcher=gacrl.Watcher(stop=lambda: True), quiet=True
    )
    assert (stopped.summary, stopped.env_steps) == (None, 32)
    assert stopped.metrics["return_agent_mean"].shape == (2, 1)
    assert repr(stopped).splitlines()[2] == "  stopped before its end: go on with `gacrl resume`"


# Evaluation.


def test_silence_changes_the_interval_of_a_policy_that_talks(run: gacrl.Run):
    """Heard, every seed earns 4. Unheard it guesses: 2 of 4 steps, and the seeds differ."""
    heard = gacrl.evaluate(run, episodes=400)["return_agent_mean"]
    silenced = gacrl.evaluate(run, episodes=400, arrives=gacrl.silence())["return_agent_mean"]
    assert (heard.mean, heard.low, heard.high) == (4.0, 4.0, 4.0)
    np.testing.assert_allclose(silenced.values, [2.0, 2.0], atol=0.2)
    assert silenced.low < silenced.mean < silenced.high and silenced.values.shape == (2,)
    assert repr(heard) == "4 [4, 4]"
    assert gacrl.evaluate(run, episodes=400, arrives=gacrl.silence([1]))["return_agent_mean"].mean == 4.0
    words = gacrl.evaluate(run, episodes=400, arrives="silence 0")["return_agent_mean"]
    np.testing.assert_array_equal(words.values, silenced.values)


def test_the_interval_of_one_seed_is_over_its_episodes(run: gacrl.Run):
    one = gacrl.evaluate(f"{run.folder}@1", episodes=400, arrives=gacrl.silence())["return_agent_mean"]
    both = gacrl.evaluate(run, episodes=400, arrives=gacrl.silence())["return_agent_mean"]
    assert one.values.shape == (400,) and set(one.values) <= {0.0, 1.0, 2.0, 3.0, 4.0}
    assert one.mean == pytest.approx(both.values[1])
    half = 1.96 * one.values.std(ddof=1) / 20
    assert (one.low, one.high) == pytest.approx((one.mean - half, one.mean + half), abs=0.01)


def test_what_arrives_may_be_words_of_ones_own(run: gacrl.Run):
    """Everyone hears agent 0 say 1 in every step: they act by it, and are right when the sign is up."""
    said = gacrl.Arrives(values=jnp.array([[[1.0], [0.0]]]))
    told = gacrl.evaluate(run, episodes=400, arrives=said)["return_agent_mean"]
    assert told.mean == pytest.approx(2.0, abs=0.2) and told.values[0] == told.values[1]


# The loop in one's own hands.


def test_iterate_yields_what_a_run_writes(run: gacrl.Run, config: gacrl.RunConfig):
    rows = [row for progress in gacrl.iterate(config, env=Whisper()) for row in progress.rows]
    written = [json.loads(line) for line in (run.folder / "metrics.jsonl").read_text().splitlines()]
    for kind in ("seed", "env_steps", "greedy", "sampled", "update", "episodes_done"):
        assert [row[kind] for row in rows] == [row[kind] for row in written]


def test_a_trainer_mapped_over_seeds_is_the_run_of_these_seeds(config: gacrl.RunConfig):
    """States, updates and evaluations: all of it, after a chunk of two updates and one of six."""
    trainer = gacrl.trainer(config, env=Whisper())
    keys = jnp.stack([stream_key("training", seed) for seed in (3, 4)])
    states = jax.vmap(trainer.init)(keys)
    chunk = jax.jit(jax.vmap(trainer.chunk, (0, None)))
    for updates in (2, 6):
        states, report = chunk(states, updates)
    *_, last = gacrl.iterate(config, env=Whisper())
    found, expected = (state._replace(key=jax.random.key_data(state.key)) for state in (states, last.state))
    jax.tree.map(np.testing.assert_allclose, found, expected)
    assert report.episodes.ended.tolist() == [24, 24]
    evaluated = jax.vmap(trainer.evaluate, (0, None))(states, stream_key("monitor"))
    assert evaluated["return_agent_mean"].shape == (2, EPISODES)
    np.testing.assert_allclose(
        evaluated["return_agent_mean"].mean(1), [row["greedy"]["return_agent_mean"] for row in last.rows]
    )


# Policies.


def test_a_policy_is_loaded_from_a_run_or_its_folder_for_any_team(run: gacrl.Run):
    """Four agents where two were trained; whoever is not the first acts by what the first says."""
    seen = np.zeros((4, 3))
    seen[0, :2] = -1.0, 1.0
    for source in (run, run.folder, str(run.folder), f"{run.folder}@1"):
        policy = gacrl.load_policy(source, num_agents=4)
        np.testing.assert_array_equal(policy(seen)[1:], [0, 0, 0])
        np.testing.assert_array_equal(policy(-seen)[1:], [1, 1, 1])
        np.testing.assert_array_equal(policy.messages[0, :, 0], [1, 0, 0, 0])
    assert run.policy(1, num_agents=4)(seen).shape == (4,)


def test_a_policy_takes_and_gives_the_dictionaries_of_pettingzoo(run: gacrl.Run):
    seen = {"ann": np.array([1.0, 1.0, 0.0]), "bob": np.zeros(3)}
    actions = run.policy()(seen)
    assert list(actions) == ["ann", "bob"] and type(actions["bob"]) is int
    assert actions["bob"] == 1
    array = run.policy()(np.stack(list(seen.values())))
    assert list(actions.values()) == array.tolist()


# Settings.


def test_settings_are_changed_by_their_dotted_names():
    config = gacrl.preset(
        "ippo",
        **{"algorithm.network.width": 8, "algorithm": {"gamma": 0.5}, "env.num_agents": np.int64(5), "seed": 7},
    )
    assert (config.algorithm.network.width, config.algorithm.gamma, config.env.num_agents) == (8, 0.5, 5)
    assert config == replace(
        gacrl.preset("ippo"),
        seed=7,
        env=replace(gacrl.preset("ippo").env, num_agents=5),
        algorithm=replace(
            gacrl.preset("ippo").algorithm,
            gamma=0.5,
            network=replace(gacrl.preset("ippo").algorithm.network, width=8),
        ),
    )
    given: dict[str, Any] = {"network": {"depth": 3}}
    gacrl.preset("ippo", **{"algorithm": given, "algorithm.network.width": 8})
    assert given == {"network": {"depth": 3}}, "what was handed over is left as it was"


def test_a_run_is_called_by_what_it_trains():
    """A preset's name on another algorithm's settings is no title; files with such settings load as they did."""
    mixed = gacrl.RunConfig(preset="qmix")
    assert presets.label(mixed) == "gacrl" and presets.label(gacrl.preset("qmix")) == "qmix"
    assert presets.label(gacrl.preset("graph-vdn", seed=3)) == "graph-vdn"
    assert from_dict(to_dict(mixed)) == mixed


# Misuse: one exception, which says what was given, and what to do.

NOWHERE = "a folder that must not be made"
MISUSES: dict[str, tuple[Callable[[], Any], str]] = {
    "a number for settings": (
        lambda: gacrl.train(3, out=NOWHERE),  # pyright: ignore[reportArgumentType]
        r"config must be a preset's name or its settings, gacrl\.preset\('gacrl'\), not 3 \(of type int\)",
    ),
    "a function for a watcher": (
        lambda: gacrl.train("ippo", out=NOWHERE, watcher=print),  # pyright: ignore[reportArgumentType]
        r"watcher must be a gacrl\.Watcher, such as gacrl\.Watcher\(progress=print\), not <built-in function print> \(of type builtin",
    ),
    "a number for a folder": (
        lambda: gacrl.train("ippo", out=3),  # pyright: ignore[reportArgumentType]
        r"out must be the path of a new folder, not 3 \(of type int\)",
    ),
    "a seed in quotes": (
        lambda: gacrl.train("ippo", out=NOWHERE, seed="0"),  # pyright: ignore[reportArgumentType]
        "seed must be a whole number, not the string '0'",
    ),
    "a number in quotes": (
        lambda: gacrl.preset("gacrl", **{"algorithm.learning_rate": "1e-3"}),
        r"algorithm\.learning_rate must be a number, not the string '1e-3'",
    ),
    "a setting beside itself": (
        lambda: gacrl.preset("gacrl", **{"env": 3, "env.num_agents": 4}),
        r"env\.num_agents cannot be set beside env=3: leave one out",
    ),
    "a run that is none": (
        lambda: gacrl.load_policy(3),
        r"run must be a gacrl\.Run, or the folder of one, not 3 \(of type int\)",
    ),
    "a run to start from that is none": (
        lambda: gacrl.train("ippo", out=NOWHERE, begin_from=3),  # pyright: ignore[reportArgumentType]
        r"run must be a gacrl\.Run, or the folder of one, not 3 \(of type int\)",
    ),
    "a probability in quotes": (
        lambda: gacrl.drop("0.2"),  # pyright: ignore[reportArgumentType]
        "drop must be a number, not the string '0.2'",
    ),
    "an agent in quotes": (
        lambda: gacrl.silence(["0"]),  # pyright: ignore[reportArgumentType]
        "an agent to silence must be a whole number, not the string '0'",
    ),
    "a delay that is not a number": (
        lambda: gacrl.delay(float("nan")),  # pyright: ignore[reportArgumentType]
        "delay must be a whole number, not nan",
    ),
    "observations of words": (
        lambda: gacrl.load_policy("noop")([["left"] * 18] * 3),  # pyright: ignore[reportArgumentType, reportCallIssue]
        "observations must be an array of numbers, not ",
    ),
    "observations of another team": (
        lambda: gacrl.load_policy("noop")(np.zeros((4, 18))),
        r"observations must be \[agents, numbers\] = \[3, 18\], not \[4, 18\]",
    ),
    "an observation that is not finite": (
        lambda: gacrl.load_policy("noop")(np.where(np.arange(54).reshape(3, 18) == 20, np.nan, 0.0)),
        "what agent 1 sees holds a number that is not finite",
    ),
}


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("misuse", MISUSES)
def test_misuse_ends_in_one_sentence(misuse: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    call, said = MISUSES[misuse]
    with pytest.raises(gacrl.UserError, match=said) as refused:
        call()
    assert "\n" not in str(refused.value)
    assert list(tmp_path.iterdir()) == [], "nothing was made"


@pytest.mark.usefixtures("unchecked")
def test_numbers_of_numpy_are_numbers(run: gacrl.Run, config: gacrl.RunConfig):
    small = replace(config, training=replace(config.training, env_steps=np.int64(16)), num_seeds=np.int32(1))
    (progress,) = gacrl.iterate(small, seed=np.int64(2), env=Whisper())
    assert [row["seed"] for row in progress.rows] == [2]
    one, other = (
        gacrl.evaluate(run, episodes=episodes, arrives=arrives)["return_agent_mean"].values
        for episodes, arrives in ((np.int64(4), gacrl.drop(np.float32(1))), (4, gacrl.silence(np.array([0, 1]))))
    )
    np.testing.assert_array_equal(one, other)


def test_ten_agents_for_a_network_of_three_are_refused_with_what_plays_ten(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(tasks, "_OWN", {})
    for name, said in (("ippo", r"does not play with num_agents=10: "), ("paper", r"was trained with 3 agents")):
        folder = untrained(
            gacrl.preset(name, **{"algorithm.replay_capacity": 10} if name == "paper" else {}), tmp_path / name
        )
        with pytest.raises(gacrl.UserError, match=f"{said}.*leave .* out, or train .*gacrl-teams") as refused:
            gacrl.load_policy(folder, num_agents=10)
        assert "\n" not in str(refused.value)
    graph = untrained(gacrl.preset("ippo", **{"algorithm.network.torso": "graph"}), tmp_path / "graph")
    assert gacrl.load_policy(graph, num_agents=10).env.num_agents == 10
