"""Policies in the real MPE2: the same returns from the same starts, and utterances that are MPE2's."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import gacrl
from gacrl import tasks
from gacrl.adapters import mpe2
from gacrl.evaluation import references
from gacrl.tasks.navigation.environment import MOVES, Navigation, make
from gacrl.tasks.navigation.scripted import told
from gacrl.types import Actor, Decision, Memory, Observation, PRNGKey

KEY = jax.random.key(5)
EPISODES = 24


def settings_of(name: str, **changes: Any) -> Any:
    return replace(tasks.default_settings(name), **changes)


def starts(env: Any, episodes: int) -> Any:
    """Where MPE2's evaluation episodes begin, as our states [K, …]."""
    played = mpe2.scenario(env)
    worlds: list[Any] = []
    for episode in range(episodes):
        theirs = played.make()
        theirs.reset(seed=mpe2._FIRST_SEED + episode)
        worlds.append(theirs.unwrapped.world)
    return played.state_of(worlds)


def played_here(env: Any, actor: Actor, start: Any, key: PRNGKey) -> np.ndarray:
    """Returns [K] of our own environment from those starts, with the random draws of the adapter."""
    params, episodes = env.default_params(), start.clock.shape[0]

    def show(state: Any) -> Observation:
        return env.observe(state) if isinstance(env, Navigation) else env.observe(state, params)

    def one_step(loop: Any, key: PRNGKey):
        state, memory = loop
        keys = jax.random.split(key, episodes)
        decision, memory = jax.vmap(actor.policy)(memory, jax.vmap(show)(state), keys)
        state, after = jax.vmap(env.step, (0, 0, 0, None))(state, decision.action, keys, params)
        return (state, memory), after.info["reward_raw"]

    memory = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (episodes, *leaf.shape)), actor.initial_memory)
    _, rewards = jax.jit(lambda: jax.lax.scan(one_step, (start, memory), jax.random.split(key, env.max_cycles)))()
    return np.asarray(rewards.sum(0))


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("scouts", {}),
        pytest.param("speaker_listener", {}, marks=pytest.mark.soak),
        ("speaker_listener", {"talk": "actions"}),
        pytest.param("reference", {}, marks=pytest.mark.soak),
        ("reference", {"talk": "actions"}),
    ],
)
def test_the_same_returns_from_the_same_starts(name: str, changes: dict[str, Any]):
    """Random policies try every action and utterance; scripted ones choose by places, so that rounding may tip a few."""
    task, settings = tasks.find(name), settings_of(name, **changes)
    env = task.make(settings)
    start = starts(env, EPISODES)
    for who in ("random", "told", "silent"):
        actor = references.actor(task, who, env)
        theirs = mpe2.evaluate(env, actor.policy, actor.initial_memory, KEY, EPISODES)
        ours = played_here(env, actor, start, KEY)
        same = np.isclose(theirs["return_agent_mean"], ours, rtol=1e-3, atol=1e-3)
        assert same.all() if who == "random" else same.mean() > 0.8, (who, theirs["return_agent_mean"], ours)
        np.testing.assert_allclose(theirs["return_agent_mean"].mean(), ours.mean(), rtol=0.02)
        if who == "told":
            assert theirs["success_final_0.2"].mean() > 0.9


def talker(env: Navigation) -> Actor:
    """Say the number of the goal that one knows; go where the last utterance that one sees says, from the start on."""
    walk, vectors, landmarks = told(env), env.vectors, env.rules.landmarks

    def policy(memory: Memory, observation: Observation, key: PRNGKey):
        features = observation.features
        knows = features[:, vectors : vectors + landmarks]
        heard = features[:, vectors + landmarks :][:, :landmarks]
        assert observation.state is not None
        # The state's goals are replaced by what is heard: without a word everyone takes the first landmark.
        goals = jax.nn.one_hot(heard.argmax(1), landmarks).reshape(-1)
        state = jnp.concatenate([observation.state[: -goals.size], goals])
        decision, memory = walk.policy(memory, observation._replace(state=state), key)
        say = jnp.where(jnp.asarray(env.rules.speaks), knows.argmax(1), 0)
        return Decision(decision.action + MOVES * say * env.utters), memory

    return Actor(policy, ())


@pytest.mark.parametrize("name", ["speaker_listener", "reference"])
def test_utterances_are_heard_in_mpe2_a_step_later(name: str):
    """What is said reaches the other agent as an action, and not at all where messages go by a network."""
    reached = {}
    for talk in ("actions", "messages"):
        env = make(settings_of(name, talk=talk))
        actor = talker(env)
        played = mpe2.evaluate(env, actor.policy, actor.initial_memory, KEY, EPISODES)
        reached[talk] = played["success_final_0.2"].mean()
    assert reached["actions"] == 1.0
    assert reached["messages"] < 0.7


def test_the_blind_see_no_landmarks_in_mpe2_either():
    env = tasks.find("scouts").make(settings_of("scouts"))
    seen: list[np.ndarray] = []

    def policy(memory: Memory, observation: Observation, key: PRNGKey):
        jax.debug.callback(lambda features: seen.append(np.asarray(features)), observation.features)
        return Decision(jnp.zeros(3, jnp.int32)), memory

    mpe2.evaluate(env, policy, (), KEY, 1)
    jax.effects_barrier()
    landmarks = np.stack(seen)[..., 4:10]
    assert not landmarks[..., 0, :].any() and landmarks[..., 1:, :].all()


def test_what_mpe2_does_not_have_is_named():
    for name, changes, sentence in (
        ("colours", {}, "MPE2 has spread .* speaker_listener and reference: .* --backend jax"),
        ("scouts", {"num_landmarks": 2}, "MPE2 has no 2 landmarks for 3 agents"),
    ):
        env = tasks.find(name).make(settings_of(name, **changes))
        with pytest.raises(gacrl.UserError, match=sentence):
            mpe2.evaluate(env, lambda memory, seen, key: (Decision(jnp.zeros(3)), memory), (), KEY, 1)
