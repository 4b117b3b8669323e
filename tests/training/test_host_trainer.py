"""Training on environments that live in Python: the very learner that the compiled trainer makes of the same task."""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import assert_nearly_same

import gacrl
from gacrl.cli.main import main
from gacrl.config import presets
from gacrl.config.run import EvaluationConfig, RunConfig, TrainingConfig
from gacrl.evaluation.episodes import record_many
from gacrl.evaluation.evaluate import stream_key
from gacrl.tasks import own
from gacrl.training import build
from gacrl.training.host_trainer import HostTrainer
from gacrl.training.trainer import Trainer


@dataclass(frozen=True)
class Walk(gacrl.Environment):
    """Two agents on a line, without chance: what they do is all that moves them. The second lacks an action."""

    max_cycles: int = 5
    num_agents = 2
    num_actions = 3
    observation_size = 3

    def reset(self, key: Any, params: Any = ()) -> Any:
        state = jnp.array([0.4, -0.2]), jnp.zeros((), jnp.int32)
        return state, self.look(state)

    def step(self, state: Any, action: Any, key: Any, params: Any = ()) -> Any:
        places, clock = state
        state = places + 0.3 * (action - 1.0), clock + 1
        stopped = jnp.abs(state[0]).max() > 1.4
        return state, gacrl.TimeStep(self.look(state), -jnp.abs(state[0]), stopped, state[1] >= self.max_cycles)

    def look(self, state: Any) -> Any:
        places, clock = state
        features = jnp.stack([places, places[::-1], jnp.full(2, 0.1) * clock], axis=1)
        return gacrl.observe(features, available=jnp.array([[True, True, True], [True, True, False]]))


def walk(max_cycles: int = 5) -> Any:
    return gacrl.to_pettingzoo(Walk(max_cycles))


def tiny(preset: str, env: Any, **changes: Any) -> RunConfig:
    config = presets.preset(preset)
    small: dict[str, Any] = {"network": replace(config.algorithm.network, width=8, **changes)}
    if hasattr(config.algorithm, "replay_capacity"):
        small |= {"replay_capacity": 60, "batch_size": 4, "learning_starts": 8, "updates": 1}
    else:
        small |= {"update_epochs": 2}
    name, settings = own.bring(env)
    return replace(
        config,
        task=name,
        env=settings,
        algorithm=replace(config.algorithm, **small),
        training=TrainingConfig(env_steps=64, num_envs=2, num_steps=1 if "batch_size" in small else 4),
        evaluation=EvaluationConfig(interval=16, num_episodes=4, final_episodes=4),
    )


@pytest.mark.parametrize(
    ("preset", "seeds", "changes", "intervention"),
    [
        pytest.param(
            *("ippo", (3, 4), {"communication": "discrete", "recurrent": True}, "drop 0.4"), marks=pytest.mark.slow
        ),
        pytest.param("vdn", (3,), {}, "", marks=pytest.mark.soak),  # an update in every step
    ],
)
def test_a_task_without_chance_gives_the_compiled_trainers_learner(
    preset: str, seeds: tuple[int, ...], changes: dict[str, Any], intervention: str
):
    """Through both adapters; with exploration, memory, lost messages, two seeds on two devices, and two chunks."""
    found: list[Any] = []
    for env in (Walk(), gacrl.from_pettingzoo(walk, "walk")):
        config = replace(tiny(preset, env, **changes), num_seeds=len(seeds))
        config = replace(config, training=replace(config.training, intervention=intervention))
        trainer = build.make_trainer(config)
        state, reports = trainer.init(seeds), list[Any]()
        for updates in (7, 4):
            state, report = trainer.chunk(state, updates)
            reports.append((report.metrics, report.episodes))
        played = trainer.evaluate(state.learner, True, "monitor", 6)
        learned = trainer.algorithm.parameters(state.learner)
        found.append(jax.device_get((learned, reports, played, state.carry.memory, state.tally, state.episodes)))
    assert type(trainer) is HostTrainer
    assert_nearly_same(*(dict(enumerate(map(np.asarray, jax.tree.leaves(numbers)))) for numbers in found))
    assert (
        found[0][1][0][1].ended.sum() > 0 and found[0][1][1][0]["loss_td" if preset == "vdn" else "entropy"].all()
    )


def test_recorded_episodes_are_those_of_the_bare_task():
    """Words of every round among them; an environment without a render mode has no pictures."""
    config = tiny("gacrl", Walk())
    trainer = build.make_trainer(config)
    learner = jax.tree.map(lambda leaf: leaf[0], trainer.init_stacked((3,)).learner)
    policy, key = trainer.algorithm.policy(learner, True), stream_key("report")
    name, settings = own.bring(gacrl.from_pettingzoo(walk, "walk"))
    hosted = gacrl.tasks.find(name).make(settings)
    bare, there = (record_many(env, policy, trainer.memory, (), key, 3) for env in (Walk(), hosted))
    for one, other in zip(bare, there, strict=True):
        assert one.messages is not None and other.frames is None and not other.visible
        for part in ("actions", "messages", "adjacency", "reward", "reward_raw", "agent_mask"):
            np.testing.assert_allclose(getattr(one, part), getattr(other, part), rtol=1e-5)


def test_a_program_does_not_step_it():
    task = gacrl.from_pettingzoo(walk, "walk")
    with pytest.raises(gacrl.ConfigError, match="walk lives in Python, and cannot be compiled"):
        gacrl.trainer("ippo", env=task)
    config = tiny("ippo", task)
    env = gacrl.tasks.find("walk").make(config.env)
    compiled = Trainer(build.make_algorithm(config), env, build.constant(), 2, 4)
    with pytest.raises(gacrl.ConfigError, match="no compiled program can step it"):
        compiled.chunk(compiled.init((0,)), 1)


FILE = '''
import pathlib
import gacrl
from mpe2 import simple_speaker_listener_v4

class Failing:
    """Raises at its 40th step, where a file says so."""
    def __init__(self, env):
        self.env, self.taken = env, 0
    def __getattr__(self, name):
        return getattr(self.env, name)
    def step(self, actions):
        self.taken += 1
        if self.taken == 40 and pathlib.Path("broken").exists():
            raise ZeroDivisionError("the wheel came off")
        return self.env.step(actions)

def make(max_cycles: int = 10, render_mode: str | None = None):
    env = simple_speaker_listener_v4.parallel_env(max_cycles=max_cycles, render_mode=render_mode)
    return Failing(env)

zoo = gacrl.from_pettingzoo(make, "zoo")
'''
SMALL = [
    "--preset=vdn",
    "--algorithm.network.width=8",
    "--algorithm.learning-starts=8",
    "--algorithm.batch-size=4",
    "--training.num-envs=2",
    "--training.num-steps=5",
    "--evaluation.interval=20",
    "--evaluation.num-episodes=2",
    "--evaluation.final-episodes=3",
]


def test_a_run_on_mpe2_breaks_resumes_plays_and_is_seen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "zoo.py").write_text(FILE)
    (tmp_path / "broken").touch()
    task = ["--env", "zoo.py:zoo"]
    assert main(["train", *task, *SMALL, "--env-steps=100", "--out=run"]) == 2
    said = capsys.readouterr().err
    assert (
        "zoo raised ZeroDivisionError in step, after" in said
        and "the wheel came off; mend the environment" in said
    )
    assert "run --env" in said and "from environment step 60" in said
    (tmp_path / "broken").unlink()
    assert main(["resume", "run", *task]) == 0
    rows = [json.loads(line) for line in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
    assert [row["env_steps"] for row in rows] == [20, 40, 60, 80, 100]
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert (tmp_path / "run" / "episodes.gif").stat().st_size > 1000
    capsys.readouterr()
    assert main(["evaluate", "run", *task, "--episodes=3", "--json"]) == 0
    scores = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert (
        scores["final"]["greedy"]["return_agent_mean"]["mean"]
        == summary["final"]["greedy"]["return_agent_mean"]["mean"]
    )
    assert main(["evaluate", "run", *task, "--episodes=3", "--env.max-cycles=4", "--json"]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["horizon"] == 4
    assert main(["render", "run", *task, "--episodes=1", "--out=run.gif"]) == 0
    seen = gacrl.load_policy("run")
    theirs = gacrl.tasks.find("zoo").make(gacrl.tasks.default_settings("zoo")).maker.make_env()
    actions = seen(theirs.reset(seed=0)[0])
    assert list(actions) == ["speaker_0", "listener_0"] and all(
        theirs.action_space(agent).contains(action) for agent, action in actions.items()
    )
