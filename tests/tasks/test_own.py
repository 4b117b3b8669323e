"""Tasks from outside: what may be brought and what not, whole runs of one, and code of theirs that fails."""

import dataclasses
import json
import shlex
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import gacrl
from gacrl import Environment, TimeStep, observe, tasks
from gacrl.cli.main import main
from gacrl.scene import compose, discs
from gacrl.tasks import own
from gacrl.tasks.task import Metric, Task
from gacrl.training.recorder import resuming

pytestmark = pytest.mark.xdist_group("own")

BEACON = Path(__file__).parents[2] / "examples" / "own_task.py"
TINY = [
    *("--env-steps", "64", "--training.num-envs", "4", "--training.num-steps", "4", "--evaluation.interval", "32"),
    *("--evaluation.num-episodes", "2", "--evaluation.final-episodes", "4", "--algorithm.network.width", "8"),
]


@pytest.fixture(autouse=True)
def nothing_at_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tasks, "_OWN", {})


@dataclass(frozen=True)
class Walk(Environment):
    """Two agents walk on a line; the reward is where they are."""

    start: float = 0.5
    num_agents: int = 2
    num_actions: int = 2
    observation_size: int = 1
    max_cycles: int = 4

    def reset(self, key: Any, params: Any = ()) -> Any:
        state = {"x": jnp.full(2, self.start), "clock": jnp.zeros((), jnp.int32)}
        return state, self.look(state)

    def step(self, state: Any, action: Any, key: Any, params: Any = ()) -> Any:
        state = {"x": state["x"] + 2.0 * action - 1.0, "clock": state["clock"] + 1}
        return state, TimeStep(self.look(state), state["x"], jnp.asarray(False), state["clock"] >= self.max_cycles)

    def look(self, state: Any) -> Any:
        places = jnp.stack([state["x"], jnp.array([0.0, 1.0])], axis=1)
        return observe(state["x"][:, None], num_actions=2, positions=places)


# What may be brought.


@pytest.mark.parametrize("thing", [Walk, Walk(), Task("Walk", Walk, lambda settings: settings)])
def test_a_class_an_instance_and_a_record_are_tasks(thing: Any):
    name, settings = own.bring(thing)
    assert (name, settings) == ("Walk", Walk())
    assert tasks.names()[-1] == "Walk"
    assert tasks.find(name).make(settings) == Walk()


def test_the_fields_of_a_dataclass_are_its_settings():
    assert own.bring(Walk(start=2.0))[1] == Walk(start=2.0)
    env = gacrl.make_env("Walk", start=3)
    assert env == Walk(start=3.0)
    with pytest.raises(gacrl.ConfigError, match="unknown setting 'env.stat': did you mean 'env.start'"):
        gacrl.make_env("Walk", stat=3)


def test_a_page_names_a_file_as_it_was_given(monkeypatch: pytest.MonkeyPatch):
    """What resumes a run must find the file from anywhere; a page is read on another machine."""
    monkeypatch.chdir(BEACON.parent)
    name, _ = own.bring(f"{BEACON.name}:Beacon")
    assert tasks.flag(name) == f" --env {shlex.quote(f'{BEACON.absolute()}:Beacon')}"
    assert tasks.flag(name, as_given=True) == f" --env {BEACON.name}:Beacon"
    assert resuming(Path("run"), name) == f"gacrl resume run{tasks.flag(name)}"
    assert resuming(Path("run"), "reference") == "gacrl resume run", "a run of ours knows its task"


def test_one_of_ours_stays_ours():
    env = gacrl.make_env("spread", num_agents=4)
    name, settings = own.bring(env)
    assert name == "spread" and settings.num_agents == 4 and type(settings).__name__ == "SpreadSettings"


class Bare:
    num_agents = 2


def changed(**methods: Any) -> type[Walk]:
    return dataclass(frozen=True)(type("Walk", (Walk,), methods))


def given(step: dict[str, Any]) -> type[Walk]:
    """Walk, whose step gives something else."""
    return changed(step=lambda self, *a: (lambda s, after: (s, after._replace(**step)))(*Walk().step(*a)))


def seen(**change: Any) -> type[Walk]:
    """Walk, that shows something else."""
    return changed(look=lambda self, state: Walk().look(state)._replace(**change))


@pytest.mark.parametrize(
    ("thing", "said"),
    [
        (Bare, "`Bare` is no task, it has no `num_actions`: make it a gacrl.Task, or a subclass"),
        (3, "`int` is no task, it has no `num_agents`"),
        (type("Half", (Environment,), {}), "`Half` has no `reset`: a task needs reset and step"),
        (
            type(
                "NoSize",
                (Environment,),
                {"reset": Walk.reset, "step": Walk.step, "num_agents": 2, "num_actions": 2},
            ),
            "`NoSize` has no `observation_size`",
        ),
        (Walk(num_agents=0), "`Walk.num_agents` must be a whole number above 0, not 0"),
        (Walk(max_cycles=2.5), "`Walk.max_cycles` must be a whole number above 0, not 2.5"),
        (
            dataclass(frozen=True)(
                type(
                    "Held",
                    (Walk,),
                    {"__annotations__": {"w": Any}, "w": dataclasses.field(default_factory=lambda: [1])},
                )
            ),
            "Held.w is a list: settings are numbers, strings and tuples",
        ),
        (
            dataclass(frozen=True)(
                type("Needs", (Walk,), {"__annotations__": {"more": int}, "more": dataclasses.field(kw_only=True)})
            ),
            "`Needs` cannot be made without arguments",
        ),
        (
            seen(features=jnp.zeros((2, 3))),
            r"Walk.reset: what an agent sees of each agent must have the shape \[1\], not \[3\]",
        ),
        (
            seen(features=jnp.zeros((3, 1))),
            r"Walk.reset: what an agent sees must have the shape \[2, 1\], not \[3, 1\] \(agent 2 is one too many\)",
        ),
        (
            seen(features=jnp.zeros((2, 1), int)),
            r"what an agent sees must be numbers with a fraction \(float32\), not int32",
        ),
        (seen(action_mask=jnp.ones((2, 2))), "available actions must be True or False, not float32"),
        (seen(positions=jnp.zeros((2, 3))), r"positions of each agent must have the shape \[2\], not \[3\]"),
        (changed(reset=lambda self, key, params: (0, 1)), "Walk.reset must give .state, observation."),
        (
            given({"reward": jnp.zeros(3)}),
            r"Walk.step: reward must have the shape \[2\], not \[3\] .agent 2 is one too many.",
        ),
        (given({"reward": jnp.zeros(1)}), r"reward must have the shape \[2\], not \[1\] .agent 1 has none."),
        (given({"terminated": jnp.zeros(2, bool)}), r"Walk.step: terminated must have the shape \[\], not \[2\]"),
        (given({"left": jnp.zeros(2)}), "Walk.step: left must be True or False, not float32"),
        (given({"info": {"far": jnp.zeros(2)}}), r"info\['far'\] must have the shape \[\], not \[2\]"),
        (
            changed(
                step=lambda self, s, a, k, p: (lambda s, after: ({**s, "clock": 1.0 * s["clock"]}, after))(
                    *Walk().step(s, a, k)
                )
            ),
            r"\['clock'\] in the state of Walk is int32\[\] after reset and float32\[\] after step: both must be alike",
        ),
        (
            changed(step=lambda self, s, a, k, p: ({}, Walk().step(s, a, k)[1])),
            "the state of Walk has another structure after step than after reset",
        ),
        (
            Task("Walk", Walk, lambda s: s, metrics={"far": Metric("distance")}),
            "the metric far of Walk is made of 'distance', which step does not measure: it measures reward_raw",
        ),
        (Task("Walk", Walk, lambda s: s, progress="done"), "Walk.progress is 'done', which step does not measure"),
        (
            Task("Walk", Walk, lambda s: s, headline="wealth"),
            "Walk.headline is 'wealth', which is no metric of it",
        ),
        (
            Task("Walk", Walk, lambda s: s, scene=lambda s, state, p: compose(discs(jnp.zeros((5, 2)), 0.1))),
            "Walk.scene shows 5 agents, and there are 2",
        ),
        (Task("spread", Walk, lambda s: s), "there is a task 'spread' already: give yours another name"),
    ],
)
def test_what_does_not_keep_its_word_is_refused_in_one_sentence(thing: Any, said: str):
    with pytest.raises(gacrl.ConfigError, match=said) as refused:
        own.bring(thing)
    assert "\n" not in str(refused.value)


def test_an_environment_that_cannot_be_hashed_is_refused():
    unhashable = type("Walk", (Walk,), {"__hash__": None})
    with pytest.raises(gacrl.ConfigError, match="`Walk` cannot be hashed .*: make it a frozen dataclass"):
        own.bring(Task("Walk", Walk, lambda settings: unhashable()))


# Files.


def write(folder: Path, body: str, name: str = "mine.py") -> Path:
    source = folder / name
    source.write_text(body, encoding="utf-8")
    return source


GOOD = BEACON.read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("body", "name", "said"),
    [
        (GOOD, "Beakon", "unknown task of {source} 'Beakon': did you mean 'Beacon'?"),
        ("x = 1\n", "x", "`x` is no task, it has no `num_agents`"),
        ("def f(:\n", "f", "{source}:1: invalid syntax"),
        (
            "import nowhere_to_be_found\n",
            "f",
            "{source}:1: ModuleNotFoundError: No module named 'nowhere_to_be_found'",
        ),
        (
            GOOD.replace("        beacon = jax.random", "        1 / 0\n        beacon = jax.random"),
            "Beacon",
            "{source}:36: ZeroDivisionError: division by zero",
        ),
        (
            GOOD.replace('over = state["clock"]', 'if state["clock"] > 3: pass\n        over = state["clock"]'),
            "Beacon",
            "{source}:45: TracerBoolConversionError: Attempted boolean conversion of traced array with shape bool[]",
        ),
        (GOOD.replace("    num_actions = 3\n", ""), "Beacon", "`Beacon` has no `num_actions`"),
    ],
    ids=("another name", "a number", "no Python", "no import", "raises in reset", "raises in step", "no size"),
)
def test_a_file_that_holds_no_task_ends_in_one_sentence(
    body: str, name: str, said: str, tmp_path: Path, said_of: Callable[..., str]
):
    source = write(tmp_path, body)
    assert said.format(source=source) in said_of("train", "--env", f"{source}:{name}", "--out", tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.fixture
def said_of(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """What a command that fails says: one sentence."""

    def run(*words: object) -> str:
        capsys.readouterr()
        assert main([str(word) for word in words]) == 2
        said = capsys.readouterr().err
        assert said.count("\n") == 1, said
        return said

    return run


# A whole run.


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A run of Beacon of two seeds, and the file that its task is in."""
    folder = tmp_path_factory.mktemp("own")
    source = write(folder, GOOD)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tasks, "_OWN", {})
        words = ["train", "--preset", "vdn", "--env", f"{source}:Beacon", "--num-seeds", "2", *TINY]
        assert main([*words, "--algorithm.learning-starts", "8", "--out", str(folder / "run")]) == 0
    return folder / "run", source


def test_its_run_folder_says_whose_it_is(trained: tuple[Path, Path]):
    run, _ = trained
    summary = json.loads((run / "summary.json").read_text())
    assert summary["task"]["name"] == "Beacon" and summary["task"]["comparable"] == {"places": 5, "max_cycles": 6}
    assert set(summary["references"]) == {"random", "noop"}
    assert {"return_agent_mean", "reward_raw", "found"} == set(summary["final"]["greedy"]), (
        "no scores without a scale"
    )
    made = json.loads((run / "origin.json").read_text())
    assert made["task"]["source"] == "mine.py" and len(made["task"]["sha256"]) == 64
    assert json.loads((run / "config.json").read_text())["env"] == {"name": "Beacon", "places": 5, "max_cycles": 6}
    assert len(list((run / "episodes").glob("*.npz"))) == 4
    assert not (run / "episodes.gif").exists(), "it does not say where things are"


def test_it_is_gone_on_with_measured_and_compared_given_its_task_again(
    trained: tuple[Path, Path], tmp_path: Path, said_of: Callable[..., str], capsys: pytest.CaptureFixture[str]
):
    run, source = trained
    copy = shutil.copytree(run, tmp_path / "copy")
    for command in ("resume", "evaluate", "render", "compare"):
        assert "is of the task 'Beacon' of mine.py, which is not at hand: name its file again" in said_of(
            command, copy
        )
    env = ["--env", f"{source}:Beacon"]
    assert main(["evaluate", str(copy), *env, "--episodes", "4", "--horizon", "5", "--json"]) == 0
    scores = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert scores["horizon"] == 5 and set(scores["references"]) == {"random", "noop"}
    assert main(["evaluate", "noop", *env, "--episodes", "4", "--places", "3"]) == 0
    assert main(["resume", str(copy), *env, "--extend", "32"]) == 0
    assert main(["compare", str(run), *env]) == 0
    assert "found" in capsys.readouterr().out
    assert "Beacon does not say where things are" in said_of("render", copy, *env, "--out", tmp_path / "x.gif")
    assert "the task has no setting num_agents: leave --num-agents out" in said_of(
        "evaluate", copy, *env, "--num-agents", "3"
    )


def test_a_source_that_has_changed_is_one_warning(
    trained: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    run, _ = trained
    source = write(tmp_path, GOOD + "\n# changed\n")
    capsys.readouterr()
    assert main(["evaluate", str(run), "--env", f"{source}:Beacon", "--episodes", "2"]) == 0
    warned = capsys.readouterr().err
    assert warned == f"gacrl: {source} has changed since {run} was made: the task is played as it is now\n"


@pytest.mark.slow
def test_another_training_starts_with_its_policy(
    trained: tuple[Path, Path], tmp_path: Path, said_of: Callable[..., str]
):
    """The second seed of two, by name; its parameters are those of the first checkpoint, which is there at once."""
    from safetensors.numpy import load_file

    run, source = trained
    words = [
        "train",
        "--preset",
        "vdn",
        "--env",
        f"{source}:Beacon",
        *TINY,
        "--algorithm.learning-starts",
        "10000",
    ]
    out = tmp_path / "tuned"
    assert main([*words, "--from", f"{run}@1", "--out", str(out)]) == 0
    parent, child = (
        load_file(max(folder.glob("checkpoints/step-*")) / "state.safetensors") for folder in (run, out)
    )
    learned = [name for name in parent if name.startswith((".learner.network", ".learner.target"))]
    assert learned
    for name in learned:
        np.testing.assert_array_equal(parent[name][1], child[name][0], err_msg=name)
    assert child[".learner.env_steps"] == 64, "and all else begins anew"
    assert json.loads((out / "origin.json").read_text())["from"] == f"{run}@1"
    assert "has another network than this run" in said_of(
        *words, "--algorithm.network.width", "16", "--from", run, "--out", tmp_path / "wider"
    )
    assert "there is no @2" in said_of(*words, "--from", f"{run}@2", "--out", tmp_path / "third")


@pytest.mark.slow
def test_a_training_that_starts_from_another_is_not_lost_before_its_first_checkpoint(
    trained: tuple[Path, Path], tmp_path: Path
):
    run, source = trained
    name, _ = own.bring(f"{source}:Beacon")
    config = dataclasses.replace(gacrl.preset("vdn"), task=name, env=tasks.default_settings(name))
    config = dataclasses.replace(
        config,
        algorithm=dataclasses.replace(
            config.algorithm, network=dataclasses.replace(config.algorithm.network, width=8)
        ),
        training=dataclasses.replace(config.training, env_steps=64, num_envs=4, num_steps=4),
    )

    def die(progress: Any) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        gacrl.train(config, out=tmp_path / "run", watcher=gacrl.Watcher(progress=die), begin_from=run)
    kept = sorted(path.name for path in (tmp_path / "run" / "checkpoints").glob("step-*"))
    assert "step-000000000000" in kept


# Python.


def test_an_environment_of_python_trains_and_is_drawn_by_where_its_agents_are(tmp_path: Path):
    config = gacrl.preset("ippo")
    config = dataclasses.replace(
        config,
        training=dataclasses.replace(config.training, env_steps=48, num_envs=4, num_steps=4),
        evaluation=dataclasses.replace(config.evaluation, num_episodes=2, final_episodes=2),
    )
    run = gacrl.train(config, env=Walk(start=1.0), out=tmp_path / "run")
    assert run.config.task == "Walk" and run.config.env == Walk(start=1.0)
    assert (run.folder / "episodes.gif").is_file()
    assert gacrl.load_policy(run.folder)(np.zeros((2, 1))).shape == (2,)


@dataclass(frozen=True)
class Broken(Walk):
    """After a while one agent's reward, or what it sees, is not a number."""

    what: str = "reward"

    def step(self, state: Any, action: Any, key: Any, params: Any = ()) -> Any:
        state, after = super().step(state, action, key, params)
        bad = jnp.where((state["clock"] == 3) & (jnp.arange(2) == 1), jnp.nan, 0.0)
        if self.what == "reward":
            return state, after._replace(reward=after.reward + bad)
        seen = after.observation
        return state, after._replace(observation=seen._replace(features=seen.features + bad[:, None]))


@pytest.mark.parametrize(
    ("what", "said"),
    [
        ("reward", "agent 1 of Broken got a reward that is not finite, in step 3 of an environment"),
        ("sight", "agent 1 of Broken saw a number that is not finite, in step 4 of an environment"),
    ],
)
def test_numbers_that_are_not_finite_are_named_with_step_and_agent(what: str, said: str, tmp_path: Path):
    config = gacrl.preset("ippo")
    config = dataclasses.replace(
        config,
        training=dataclasses.replace(config.training, env_steps=48, num_envs=2, num_steps=4),
        evaluation=dataclasses.replace(config.evaluation, interval=8, num_episodes=2, final_episodes=2),
    )
    with pytest.raises(gacrl.UserError, match=f"{said} .seed 0.: mend the task, then go on with `gacrl resume"):
        gacrl.train(config, env=Broken(what=what), out=tmp_path / "run")


def test_policies_of_different_agents_are_masked_and_told_apart():
    """The one that cannot move has one action; both have a role among their features."""
    own.bring(f"{BEACON}:Beacon")
    env = gacrl.make_env("Beacon")
    _, first = env.reset(jax.random.key(0))
    np.testing.assert_array_equal(first.action_mask.sum(1), [1, 3])
    np.testing.assert_array_equal(first.features[:, -2:], np.eye(2))
