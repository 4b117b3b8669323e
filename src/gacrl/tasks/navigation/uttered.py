"""Symbols sent as MPE2's utterance actions: agents that learned to talk within a step talk by what MPE2 has for it.

What is said is an action, and is seen by the other agents a step later, in MPE2 itself where it is played there.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp

from gacrl.config.checks import require
from gacrl.tasks.navigation.environment import MOVES, Navigation
from gacrl.types import Arrives, Decision, Memory, Observation, Policy, PRNGKey


def uttered(env: Navigation, policy: Policy) -> tuple[Navigation, Policy]:
    """Return the task with utterances among the actions, and a policy that utters what `policy` says without them.

    It hears what it sees of the others' utterances; of who has said nothing yet it hears nothing. Raises ConfigError
    where the task has none, and, called, where the agents say anything but one symbol a step that is an utterance.
    """
    rules, num_agents = env.rules, env.num_agents
    require(rules.words > 0, "this task has no utterances among its actions: leave --utter out")
    require(not env.utters, "utterances are among the actions of this policy already: leave --utter out")
    begin = env.vectors + rules.landmarks
    end = begin + rules.words * (num_agents - 1)
    speaks = jnp.asarray(rules.speaks)

    def act(memory: Memory, observation: Observation, key: PRNGKey) -> tuple[Decision, Memory]:
        features = observation.features
        rows = features[:, begin:end].reshape(num_agents, num_agents - 1, rules.words)
        heard = jnp.stack([jnp.insert(rows[i], i, 0.0, axis=0) for i in range(num_agents)])
        words = heard.max(0)  # of each speaker: who cannot hear it sees zeros, and has no edge
        seen = env.from_features(features.at[:, begin:end].set(0.0))._replace(state=observation.state)
        said = jax.eval_shape(policy, memory, seen, key)[0].messages
        require(said is not None, "the agents say nothing that could be uttered")
        rounds, _, symbols = said.shape
        require(
            rounds == 1 and symbols <= rules.words,
            f"an utterance is one of {rules.words} words a step, and the agents say {rounds} of {symbols}: train them "
            f"with --algorithm.network.rounds 1 --algorithm.network.vocabulary {rules.words}",
        )
        kept = jnp.broadcast_to(words.any(-1), (num_agents, num_agents))
        arrives = Arrives(values=words[None, :, :symbols], kept=kept)
        decision, memory = policy(memory, seen._replace(arrives=arrives), key)
        assert decision.messages is not None
        utterance = jnp.where(speaks, decision.messages[0].argmax(-1), 0)
        return decision._replace(action=decision.action + MOVES * utterance), memory

    return replace(env, utters=True), act
