"""What a task gets without asking: masks that are filled, features side by side, and the defaults of an environment."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gacrl import rollout
from gacrl.algorithms.actions import choices
from gacrl.envs.environment import Environment, TimeStep, observe, side_by_side, with_self
from gacrl.types import Decision, Entities, Observation

FEATURES = jnp.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]])


def same(found: Observation, **expected: Any) -> None:
    """What is not named holds nothing; values and types are those that are expected."""
    for name, value in found._asdict().items():
        if name in expected:
            np.testing.assert_array_equal(value, expected[name], err_msg=name)
            assert value.dtype == np.asarray(expected[name]).dtype, name
        else:
            assert not jax.tree.leaves(value), name


# Observations.


def test_by_default_everyone_is_there_and_may_do_everything():
    for see in (observe, jax.jit(observe, static_argnames="num_actions")):
        same(
            see(FEATURES, num_actions=4),
            features=FEATURES,
            agent_mask=np.ones(3, bool),
            action_mask=np.ones((3, 4), bool),
        )


def test_what_is_said_of_an_observation_stands_in_it():
    alive, available = np.array([True, False, True]), np.array([[True, False], [False, True], [True, True]])
    positions, adjacency = np.arange(6, dtype=np.float32).reshape(3, 2), np.eye(3, dtype=bool)
    state = np.array([9.0, 8.0], np.float32)
    seen = observe(
        FEATURES,
        positions=jnp.asarray(positions),
        alive=jnp.asarray(alive),
        available=jnp.asarray(available),
        adjacency=jnp.asarray(adjacency),
        state=jnp.asarray(state),
    )
    same(
        seen,
        features=FEATURES,
        positions=positions,
        agent_mask=alive,
        action_mask=available,
        adjacency=adjacency,
        state=state,
    )
    # The actions that each agent has, where both are said.
    both = observe(FEATURES, num_actions=2, available=jnp.asarray(available))
    same(both, features=FEATURES, agent_mask=np.ones(3, bool), action_mask=available)


def test_the_actions_must_be_known():
    with pytest.raises(ValueError, match=r"observe needs num_actions, or available \[N, A\]"):
        observe(FEATURES)


def test_features_side_by_side_by_hand():
    """A scout with three numbers, two guards with one: zeros up to three, then who it is."""
    seen = [jnp.array([1.0, 2.0, 3.0]), jnp.array([4.0]), jnp.array([5.0])]
    np.testing.assert_array_equal(
        side_by_side(seen),
        [[1, 2, 3, 1, 0, 0], [4, 0, 0, 0, 1, 0], [5, 0, 0, 0, 0, 1]],
    )
    np.testing.assert_array_equal(
        jax.jit(lambda *seen: side_by_side(seen, roles=[1, 0, 0]))(*seen),
        [[1, 2, 3, 0, 1], [4, 0, 0, 1, 0], [5, 0, 0, 1, 0]],
    )
    np.testing.assert_array_equal(
        side_by_side(seen, roles=[0, 2, 2]), [[1, 2, 3, 1, 0, 0], [4, 0, 0, 0, 0, 1], [5, 0, 0, 0, 0, 1]]
    )
    np.testing.assert_array_equal(
        side_by_side([jnp.array([7.0]), jnp.array([8.0])], roles=[0, 0]), [[7, 1], [8, 1]]
    )
    # Who sees nothing is told apart all the same.
    np.testing.assert_array_equal(side_by_side([jnp.zeros(0), jnp.array([6.0])]), [[0, 1, 0], [6, 0, 1]])


# Environments.


class Counted(NamedTuple):
    """How often each agent has counted."""

    sums: Any
    clock: Any


@dataclass(frozen=True)
class Counting(Environment):
    """Three agents count by 0 or 1 a step, and earn what they have counted; the last one is never there.

    The simplest task there is: it says its sizes, and has reset and step.
    """

    max_cycles: int = 2
    num_agents: int = 3
    num_actions: int = 2
    observation_size: int = 1

    def reset(self, key: Any, params: Any = ()) -> Any:
        state = Counted(jnp.zeros(3), jnp.zeros((), jnp.int32))
        return state, self.see(state)

    def step(self, state: Counted, action: Any, key: Any, params: Any = ()) -> Any:
        state = Counted(state.sums + action, state.clock + 1)
        over = jnp.zeros((), bool)
        return state, TimeStep(self.see(state), state.sums, over, state.clock >= self.max_cycles)

    def see(self, state: Counted) -> Observation:
        return observe(state.sums[:, None], num_actions=2, alive=jnp.array([True, True, False]))


ENV = Counting()
KEY = jax.random.key(0)


def test_what_an_environment_must_say_itself():
    class Idle(Environment):
        """Nothing ever happens."""

    with pytest.raises(TypeError, match="abstract"):
        Idle()  # pyright: ignore[reportAbstractUsage]
    assert hash(ENV) == hash(Counting()) and Counting() == ENV, "a constant of compiled programs"


def test_the_defaults_of_an_environment():
    assert ENV.default_params() == ()
    assert (ENV.continuous_actions, ENV.num_symmetries, ENV.observes_state) == (False, 1, False)
    with pytest.raises(NotImplementedError):
        ENV.observe_many(Counted(jnp.zeros((4, 3)), jnp.zeros(4)))
    step = ENV.step(ENV.reset(KEY)[0], jnp.array([1, 0, 1]), KEY)[1]
    assert (step.info, step.left) == ({}, None)


def test_bare_features_are_everyones_and_everything_may_be_done():
    same(
        ENV.from_features(FEATURES),
        features=FEATURES,
        agent_mask=np.ones(3, bool),
        action_mask=np.ones((3, 2), bool),
    )


def test_by_default_an_agent_is_alone_with_what_it_sees():
    seen = ENV.entities(ENV.from_features(FEATURES))
    np.testing.assert_array_equal(seen.own, FEATURES)
    assert seen.landmarks.shape == seen.agents.shape == (3, 0, 2)
    assert seen.landmark_mask.shape == seen.agent_mask.shape == (3, 0)
    assert seen.landmark_mask.dtype == seen.agent_mask.dtype == bool
    assert (seen.landmark_features, seen.agent_features) == (None, None)


def test_a_task_without_symmetries_is_not_turned():
    seen, action = ENV.from_features(FEATURES), jnp.array([1, 0, 1])
    assert ENV.turn(seen, jnp.asarray(0)) is seen
    assert ENV.turn_action(action, jnp.asarray(0)) is action
    pushes = choices(ENV)
    assert pushes.size == 2
    np.testing.assert_array_equal(pushes.turn(action, jnp.asarray(0)), action)


def test_many_copies_are_the_step_of_each():
    states = Counted(jnp.arange(12.0).reshape(4, 3), jnp.array([0, 1, 0, 1]))
    action = jnp.asarray(np.random.default_rng(0).integers(2, size=(4, 3)))
    after, step = jax.jit(ENV.step_many)(states, action, jax.random.split(KEY, 4))
    np.testing.assert_array_equal(after.sums, states.sums + action)
    np.testing.assert_array_equal(step.reward, after.sums)
    np.testing.assert_array_equal(step.observation.features[..., 0], after.sums)
    np.testing.assert_array_equal(step.truncated, [False, True, False, True])


# What agents see of each other.


def test_an_entry_for_oneself_goes_between_those_for_the_others():
    pairs = jnp.array([[[1.0, 2.0], [3.0, 4.0]], [[5.0, 6.0], [7.0, 8.0]], [[9.0, 10.0], [11.0, 12.0]]])
    expected = [
        [[0, 0], [1, 2], [3, 4]],
        [[5, 6], [0, 0], [7, 8]],
        [[9, 10], [11, 12], [0, 0]],
    ]
    np.testing.assert_array_equal(with_self(pairs), expected)
    np.testing.assert_array_equal(with_self(jnp.array([[[1.0]], [[2.0]]])), [[[0], [1]], [[2], [0]]])
    np.testing.assert_array_equal(with_self(jnp.zeros((1, 0, 3))), np.zeros((1, 1, 3)))
    assert with_self(jnp.zeros((4, 3, 0))).shape == (4, 4, 0)


@dataclass(frozen=True)
class Watched(Counting):
    """Offsets 1 to 12 to the others, and features that are the offsets' first numbers times 100."""

    told: bool = False
    others: int = 2

    def entities(self, observation: Observation) -> Entities:
        alone = super().entities(observation)
        agents = jnp.arange(1.0, 1 + 6 * self.others).reshape(3, self.others, 2)
        there = jnp.ones((3, self.others), bool).at[1, :1].set(False).at[2].set(False)
        features = 100 * agents[..., :1] if self.told else None
        return alone._replace(agents=agents, agent_mask=there, agent_features=features)


def test_by_default_agents_see_of_each_other_what_the_entities_say():
    """Agent 1 does not see agent 0, agent 2 nobody: of whom they do not see they are told nothing."""
    _, seen = ENV.reset(KEY)
    offsets = [[[0, 0], [1, 2], [3, 4]], [[0, 0], [0, 0], [7, 8]], [[0, 0], [0, 0], [0, 0]]]
    np.testing.assert_array_equal(Watched().sight(seen), offsets)
    features = np.array([[0, 100, 300], [0, 0, 700], [0, 0, 0]])[..., None]
    np.testing.assert_array_equal(Watched(told=True).sight(seen), np.concatenate([offsets, features], axis=-1))


def test_agents_that_are_alone_or_tell_of_a_few_only_see_nobody():
    """Entities that are not all others in order do not say whose voice is whose."""
    _, seen = ENV.reset(KEY)
    for env in (ENV, Watched(others=0), Watched(others=1), Watched(others=3)):
        assert env.sight(seen).shape == (3, 3, 0)


# What a rollout makes of it.


def test_the_mean_reward_is_that_of_those_who_are_there_unless_the_task_says_it():
    _, seen = ENV.reset(KEY)
    step = TimeStep(seen, jnp.array([1.0, 3.0, 100.0]), jnp.array(False), jnp.array(False))
    assert {name: float(value) for name, value in rollout.measured(step).items()} == {"reward_raw": 2.0}
    more = step._replace(info={"counted": jnp.array(5.0)})
    found = rollout.measured(more)
    assert {name: float(value) for name, value in found.items()} == {"reward_raw": 2.0, "counted": 5.0}
    said = step._replace(info={"reward_raw": jnp.array(-1.0)})
    assert rollout.measured(said) is said.info
    nobody = step._replace(observation=seen._replace(agent_mask=jnp.zeros(3, bool)))
    assert float(rollout.measured(nobody)["reward_raw"]) == 0.0


def count_on(memory: Any, observation: Observation, key: Any) -> Any:
    """Everyone counts; what is remembered is how often each did, and how often anyone was asked."""
    mine, ours = memory
    return Decision(jnp.ones(3, jnp.int32), extras=memory), (mine + 1, ours + 1)


@dataclass(frozen=True)
class Relay(Counting):
    """The first agent hands over with every second step, inside the episode."""

    max_cycles: int = 5

    def step(self, state: Counted, action: Any, key: Any, params: Any = ()) -> Any:
        state, after = super().step(state, action, key)
        return state, after._replace(left=(state.clock % 2 == 0) & jnp.array([True, False, False]))


def test_the_simplest_task_is_played_and_begins_anew():
    """Two episodes of two steps, side by side; memory is fresh where an episode opens."""
    fresh = (jnp.zeros(3), jnp.zeros(()))
    carry = rollout.start(ENV, (), fresh, KEY, 2)
    after, experience = rollout.collect(ENV, count_on, fresh, (), carry, KEY, 4)
    steps = experience.transitions
    np.testing.assert_array_equal(steps.reward[:, 0], [[1] * 3, [2] * 3, [1] * 3, [2] * 3])
    np.testing.assert_array_equal(steps.reward[:, 1], steps.reward[:, 0])
    np.testing.assert_array_equal(steps.first[:, 0], [True, False, True, False])
    np.testing.assert_array_equal(steps.truncated[:, 0], [False, True, False, True])
    np.testing.assert_array_equal(steps.observation.features[:, 0, 0, 0], [0, 1, 0, 1])
    np.testing.assert_array_equal(steps.next_observation.features[:, 0, 0, 0], [1, 2, 1, 2])
    np.testing.assert_array_equal(steps.info["reward_raw"][:, 0], [1, 2, 1, 2])
    np.testing.assert_array_equal(steps.decision.extras[0][:, 0, 0], [0, 1, 0, 1])
    assert steps.left is None
    np.testing.assert_array_equal(after.memory[0], 0.0)
    assert after.first.all()


def test_who_takes_a_slot_remembers_nothing_of_who_left_it():
    """Six steps: the first agent's memory begins anew after steps 2 and 4, everyone's after 5; the team's after 5."""
    env, fresh = Relay(), (jnp.zeros(3), jnp.zeros(()))
    carry = rollout.start(env, (), fresh, KEY, 1)
    after, experience = rollout.collect(env, count_on, fresh, (), carry, KEY, 6)
    steps = experience.transitions
    np.testing.assert_array_equal(steps.left[:, 0, 0], [False, True, False, True, False, False])
    assert not steps.left[:, 0, 1:].any()
    mine, ours = steps.decision.extras
    np.testing.assert_array_equal(mine[:, 0], [[0, 0, 0], [1, 1, 1], [0, 2, 2], [1, 3, 3], [0, 4, 4], [0, 0, 0]])
    np.testing.assert_array_equal(ours[:, 0], [0, 1, 2, 3, 4, 0])
    np.testing.assert_array_equal(steps.first[:, 0], [True, False, False, False, False, True])
    np.testing.assert_array_equal(steps.observation.features[:, 0, 1, 0], [0, 1, 2, 3, 4, 0])
    np.testing.assert_array_equal(after.memory[0][0], [1, 1, 1])
