"""Every learner takes every kind of message: one update moves every weight that the agents talk with."""

from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import drawn_learner, soaked

from gacrl import rollout
from gacrl.algorithms import build as algorithms
from gacrl.config import presets
from gacrl.config.algorithms import (
    IppoConfig,
    IqlConfig,
    MappoConfig,
    NetworkConfig,
    QmixConfig,
    VdnConfig,
)
from gacrl.config.run import TrainingConfig
from gacrl.tasks.spread.environment import Spread

ENV = Spread(3, 2, max_cycles=4)
PPO = {"update_epochs": 1, "num_minibatches": 1}
REPLAYED = {"learning_starts": 0, "replay_capacity": 240, "batch_size": 8, "updates": 1}
LEARNERS: dict[str, Any] = {
    "ippo": IppoConfig(**PPO),
    "mappo": MappoConfig(**PPO),
    "iql": IqlConfig(**REPLAYED),
    "vdn": VdnConfig(**REPLAYED),
    "qmix": QmixConfig(mixer_width=4, **REPLAYED),
    "gacrl": replace(presets.preset("gacrl").algorithm, **REPLAYED),
}
KINDS: dict[str, dict[str, Any]] = {
    "told": {"communication": "told"},
    "tarmac": {"communication": "tarmac", "rounds": 2, "signature_size": 2, "value_size": 3},
    "ic3net": {"communication": "ic3net", "rounds": 2},
    "gated": {
        "communication": "discrete",
        "rounds": 2,
        "vocabulary": 4,
        "gate": True,
        "word_price": 0.01,
        "logit_price": 0.0,
        "symbol_noise": 1.0,
    },
}


KEPT = [("gacrl", "gated"), ("vdn", "gated"), ("ippo", "told"), ("ippo", "tarmac"), ("ippo", "ic3net")]
SLOW = [("ippo", "gated"), ("vdn", "told"), ("vdn", "tarmac"), ("vdn", "ic3net")]
"""The agents of MAPPO, IQL and QMIX are IPPO's and VDN's: they are soaked, and other kinds of GACRL's."""
PAIRS = soaked([(name, kind) for name in LEARNERS for kind in KINDS], *KEPT, slow=SLOW)


@pytest.mark.parametrize(("name", "kind"), PAIRS)
def test_one_update_moves_every_weight_that_agents_talk_with(name: str, kind: str):
    """And the price of words is a part of the loss: 0.01 for each that was said, of at most two an agent and step."""
    network = replace(LEARNERS[name].network, width=8, depth=1, radius=10.0, **KINDS[kind])
    config = replace(LEARNERS[name], network=network, learning_rate=0.01, learning_rate_end=0.01)
    training = TrainingConfig(env_steps=1_000, num_envs=4, num_steps=6)
    algorithm = algorithms.make(config, ENV, training, "coverage_0.2")
    learner, memory, params = drawn_learner(algorithm), algorithm.initial_memory(3), ENV.default_params()

    @jax.jit
    def update(learner: Any) -> Any:
        carry = rollout.start(ENV, params, memory, jax.random.key(0), 4)
        policy = algorithm.policy(learner, True)
        _, experience = rollout.collect(ENV, policy, memory, params, carry, jax.random.key(1), 6)
        return *algorithm.update(learner, experience, jax.random.key(2)), experience

    def talk(learner: Any) -> Any:
        agent = learner.network.actor if name in ("ippo", "mappo") else learner.network.agent
        return agent.communication

    if kind == "gated":  # so that listeners have a choice of speakers
        open_ = tuple(eqx.tree_at(lambda gate: gate.bias, gate, gate.bias + 3.0) for gate in talk(learner).gate)
        learner = eqx.tree_at(lambda learner: talk(learner).gate, learner, open_)
    after, metrics, experience = update(learner)
    assert all(np.isfinite(value).all() for value in jax.tree.leaves(metrics))
    if name in ("ippo", "mappo"):
        assert metrics["ratio_clipped"] == 0.0 and abs(metrics["kl"]) < 1e-6
    moved = jax.tree.map(lambda new, old: float(jnp.abs(new - old).max()), talk(after), talk(learner))
    for path, distance in jax.tree_util.tree_leaves_with_path(moved):
        assert distance > 1e-3, jax.tree_util.keystr(path)
    assert ("loss_messages" in metrics) == (kind == "gated")
    if kind == "gated":
        words = metrics["loss_messages"] / 0.01
        assert 0 < words < 2
        if name in ("ippo", "mappo"):
            said = experience.transitions.decision.messages.sum((-3, -1)).mean()
            np.testing.assert_allclose(words, said, rtol=1e-5)


def test_a_network_of_a_preset_with_another_kind_is_of_that_kind():
    """What a preset sets for its own kind stays, and does not disturb."""
    for preset in ("gacrl", "commnet", "dial"):
        network = presets.preset(preset).algorithm.network
        for kind in KINDS.values():
            assert isinstance(replace(network, **kind), NetworkConfig)
