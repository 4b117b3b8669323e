"""Symbols sent as utterance actions: they arrive a step late, as the intervention that delays them says."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import drawn

from gacrl import tasks
from gacrl.adapters import mpe2
from gacrl.config import files as configuration
from gacrl.config.algorithms import NetworkConfig
from gacrl.errors import ConfigError, UserError
from gacrl.evaluation.evaluate import evaluate
from gacrl.experiments import scoring
from gacrl.messages.interventions import delay, silence
from gacrl.networks.agent import AgentNetwork
from gacrl.tasks.navigation.environment import make
from gacrl.tasks.navigation.uttered import uttered
from gacrl.types import Decision, Memory, Observation, Policy, PRNGKey

KEY = jax.random.key(3)
NETWORK = NetworkConfig(torso="graph", width=16, communication="discrete", vocabulary=10, second_look=True)


def listeners(config: NetworkConfig) -> Policy:
    """Agents with drawn weights, which say one thing here and another there."""
    network = drawn(AgentNetwork, REFERENCE, config, 5)

    def policy(memory: Memory, observation: Observation, key: PRNGKey):
        output, _ = network(observation)
        return Decision(output.head.argmax(-1), output.messages, output.adjacency), memory

    return policy


REFERENCE = make(tasks.default_settings("reference"))


def test_what_is_uttered_is_heard_as_what_is_a_step_late():
    policy, params = listeners(NETWORK), REFERENCE.default_params()
    env, speaking = uttered(REFERENCE, policy)
    late = evaluate(REFERENCE, policy, (), params, KEY, 8, delay(1))["return_agent_mean"]
    spoken = evaluate(env, speaking, (), params, KEY, 8)["return_agent_mean"]
    np.testing.assert_allclose(spoken, late, rtol=1e-5)


@pytest.mark.soak
def test_utterances_reach_their_listeners_in_mpe2_too():
    policy, params = listeners(NETWORK), REFERENCE.default_params()
    env, speaking = uttered(REFERENCE, policy)
    here = evaluate(env, speaking, (), params, KEY, 64)["return_agent_mean"]
    mute = evaluate(REFERENCE, policy, (), params, KEY, 64, silence())["return_agent_mean"]
    assert not np.allclose(here, mute, rtol=1e-2), "these agents listen"
    theirs = mpe2.evaluate(env, speaking, (), KEY, 64)["return_agent_mean"]
    error = np.hypot(np.std(here), theirs.std()) / np.sqrt(64)
    assert abs(np.mean(here) - theirs.mean()) < 4 * error, "on its own starts"


def test_what_cannot_be_uttered_is_named():
    state, seen = REFERENCE.reset(KEY)
    _, speaking = uttered(REFERENCE, listeners(replace(NETWORK, rounds=2)))
    with pytest.raises(ConfigError, match="an utterance is one of 10 words a step, and the agents say 2 of 10"):
        speaking((), seen, KEY)
    _, mute = uttered(REFERENCE, listeners(replace(NETWORK, communication="none")))
    with pytest.raises(ConfigError, match="the agents say nothing that could be uttered"):
        mute((), seen, KEY)
    with pytest.raises(ConfigError, match="no utterances among its actions"):
        uttered(make(tasks.default_settings("colours")), listeners(NETWORK))
    assert jnp.all(state.words == -1)


@pytest.mark.parametrize(
    ("changes", "says"), [({"gate": True}, "may say nothing"), ({"communication": "commnet"}, "send commnet")]
)
def test_only_words_in_every_step_are_uttered(changes: dict[str, Any], says: str):
    config = configuration.from_dict({"algorithm": {"network": changes}}, configuration.preset("gacrl"))
    with pytest.raises(UserError, match=f"these agents {says}: leave --utter out"):
        scoring._require_utterable(tasks.find("reference"), config)
