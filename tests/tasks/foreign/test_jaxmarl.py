"""JaxMARL's API both ways, on a stand-in with its conventions: JaxMARL itself is in an environment of its own."""

import sys
from types import ModuleType, SimpleNamespace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import gacrl
from gacrl import tasks
from gacrl.tasks import own


class Discrete(NamedTuple):
    n: int


class Inner(NamedTuple):
    place: Any
    step: Any


class Pair:
    """Its clock is looked at before it counts: `max_steps` + 1 steps. The runner is out after step 2.

    The episode is over at once when the walker chooses action 3.
    """

    agents = ("walker_0", "runner_0")

    def __init__(self, max_steps: int = 3, speed: float = 1.0, shape: Any = None):
        self.max_steps, self.speed = max_steps, speed

    def action_space(self, agent: str) -> Any:
        return Discrete(4 if agent == "walker_0" else 2)

    def reset(self, key: Any) -> Any:
        state = Inner(jax.random.uniform(key), jnp.zeros((), jnp.int32))
        return self.get_obs(state), state

    def get_obs(self, state: Inner) -> Any:
        return {
            "walker_0": jnp.stack([state.place] * 3),
            "runner_0": state.place[None, None],
            "world_state": state.place,
        }

    def get_avail_actions(self, state: Inner) -> Any:
        return {"walker_0": jnp.array([1, 1, 0, 1]), "runner_0": jnp.array([1, 1])}

    def step_env(self, key: Any, state: Inner, actions: Any) -> Any:
        stopped, late = actions["walker_0"] == 3, state.step >= self.max_steps
        state = Inner(state.place + self.speed * actions["walker_0"], state.step + 1)
        over = stopped | late
        dones = {"walker_0": over, "runner_0": over | (state.step >= 2), "__all__": over}
        return self.get_obs(state), state, {"walker_0": state.place, "runner_0": 2.0}, dones, {}


@pytest.fixture(autouse=True)
def stand_in(monkeypatch: pytest.MonkeyPatch) -> None:
    def make(name: str, **settings: Any) -> Any:
        if name != "pair":
            raise ValueError(f"{name} is not in registered jaxmarl environments.")
        return Pair(**settings)

    jaxmarl, environments, spaces = (ModuleType(name) for name in ("jaxmarl", "environments", "spaces"))
    vars(jaxmarl)["make"] = make
    vars(spaces).update(Discrete=Discrete, Box=lambda low, high, shape: SimpleNamespace(shape=shape))
    for name, module in (("", jaxmarl), (".environments", environments), (".environments.spaces", spaces)):
        monkeypatch.setitem(sys.modules, f"jaxmarl{name}", module)


def test_an_environment_of_jaxmarl_is_a_task():
    name, settings = own.bring("jaxmarl:pair")
    assert vars(settings) == {"max_steps": 3, "speed": 1.0} and tasks.flag(name) == " --env jaxmarl:pair"
    env = gacrl.make_env(name, speed=0.5)
    assert (env.num_agents, env.num_actions, env.observation_size, env.max_cycles) == (2, 4, 3 + 2, 4)
    state, seen = env.reset(jax.random.key(0))
    place = float(jax.random.uniform(jax.random.key(0)))
    np.testing.assert_allclose(seen.features, [[place] * 3 + [1, 0], [place, 0, 0, 0, 1]])
    assert seen.action_mask.tolist() == [[True, True, False, True], [True, True, False, False]]
    steps = []
    for _ in range(4):
        state, step = jax.jit(env.step)(state, jnp.array([1, 0]), jax.random.key(1))
        steps.append(step)
    assert [(bool(step.terminated), bool(step.truncated)) for step in steps] == [(False, False)] * 3 + [
        (False, True)
    ]
    assert [step.left.tolist() for step in steps] == [
        [False, False],
        [False, True],
        [False, False],
        [False, False],
    ]
    assert [step.observation.agent_mask.tolist()[1] for step in steps] == [True, False, False, False]
    assert steps[2].reward.tolist()[1] == 0 and steps[1].reward.tolist()[1] == 2
    np.testing.assert_allclose(
        [step.info["reward_raw"] for step in steps], [(place + 2.5) / 2, (place + 3) / 2, place + 1.5, place + 2]
    )
    _, early = env.step(env.reset(jax.random.key(0))[0], jnp.array([3, 0]), jax.random.key(1))
    assert (bool(early.terminated), bool(early.truncated)) == (True, False)


def test_our_tasks_have_its_api():
    """Its `step` goes on with the next episode; `step_env` gives the very numbers of the task."""
    settings = {"max_cycles": 3}
    env, bare = gacrl.to_jaxmarl("speaker_listener", **settings), gacrl.make_env("speaker_listener", **settings)
    assert (
        env.observation_space("agent_1").shape == (bare.observation_size,)
        and env.action_space("agent_0").n == bare.num_actions
    )
    keys = jax.random.split(jax.random.key(2), 5)
    seen, state = jax.jit(env.reset)(keys[0])
    inner, observation = bare.reset(keys[0], bare.default_params())
    step, step_env = jax.jit(env.step), jax.jit(env.step_env)
    for number, key in enumerate(keys[1:4]):
        np.testing.assert_array_equal(np.stack(list(seen.values())), observation.features)
        np.testing.assert_array_equal(
            np.stack(list(env.get_avail_actions(state).values())), observation.action_mask
        )
        actions = {"agent_0": jnp.int32(number % 3), "agent_1": jnp.int32(number)}
        inner, after = bare.step(inner, jnp.stack(list(actions.values())), key, bare.default_params())
        observation = after.observation
        ended = step_env(key, state, actions)
        np.testing.assert_allclose(np.stack(list(ended[2].values())), after.reward, rtol=1e-6)
        assert ended[3].keys() == {"agent_0", "agent_1", "__all__"} and bool(ended[3]["__all__"]) == (number == 2)
        seen, state, _, dones, infos = step(key, state, actions)
        assert infos["reward_raw"].shape == (2,) and bool(dones["agent_1"]) == (number == 2)
    assert int(state.step) == 0 and not np.allclose(seen["agent_1"], observation.features[1])
    assert int(step(key, ended[1], actions, ended[1])[1].step) == 3, "a reset state opens the next episode"


@pytest.mark.parametrize(
    ("use", "sentence"),
    [
        (lambda: own.bring("jaxmarl:pear"), "--env jaxmarl:pear: ValueError: pear is not in registered"),
        (
            lambda: gacrl.to_jaxmarl("spread", continuous_actions=True),
            "spread has continuous actions, and JaxMARL's",
        ),
        (lambda: gacrl.make_env("jaxmarl:pair", max_steps=0), "does not say how long an episode is"),
    ],
)
def test_mistakes_are_one_sentence(use: Any, sentence: str, unchecked: None):
    with pytest.raises(gacrl.ConfigError) as error:
        use()
    assert sentence in str(error.value)


def test_without_jaxmarl_one_is_told_what_to_install(monkeypatch: pytest.MonkeyPatch, unchecked: None):
    for module in [name for name in sys.modules if name.partition(".")[0] == "jaxmarl"]:
        monkeypatch.setitem(sys.modules, module, None)
    for use in (lambda: own.bring("jaxmarl:pair"), lambda: gacrl.to_jaxmarl("reference")):
        with pytest.raises(gacrl.ConfigError, match="install it with `pip install jaxmarl`"):
            use()
