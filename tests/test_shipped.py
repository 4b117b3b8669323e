"""Shipped policies are seed 0 of the tables: what their cards say, what they play, and a plain loop of MPE2."""

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpe2 import simple_spread_v3

import gacrl

ROOT = Path(__file__).parent.parent
DATA = ROOT / "docs" / "data"
TABLES = {
    "gacrl": "gacrl-10-seeds",
    "gacrl-112k": "gacrl-112k-4-seeds",
    "gacrl-teams": "gacrl-teams-4-seeds",
    "gacrl-reference": "talk-reference-10-seeds",
    "gacrl-colours": "talk-colours-10-seeds",
    "gacrl-traffic": "talk-traffic-easy-3-seeds",
}


def values_of(table: str) -> dict[str, list[float]]:
    """Every seed's value of each metric, greedy."""
    final = json.loads((DATA / f"{table}.json").read_text(encoding="utf-8"))["final"]["greedy"]
    return {metric: entry["values"] for metric, entry in final.items()}


@pytest.mark.parametrize("name", TABLES)
def test_a_card_says_which_seed_of_which_table_a_policy_is(name: str):
    folder = ROOT / "src" / "gacrl" / "pretrained" / name
    card: dict[str, Any] = json.loads((folder / "card.json").read_text(encoding="utf-8"))
    (tensors,) = folder.glob("checkpoints/*/state.safetensors")
    assert card["sha256"] == hashlib.sha256(tensors.read_bytes()).hexdigest()
    assert len(card["versions"]["git_commit"]) == 40
    table = values_of(TABLES[name])
    assert card["seed"] == 0 and "return_agent_mean" in card["greedy"]
    assert card["greedy"] == {metric: table[metric][0] for metric in card["greedy"]}


@pytest.mark.soak
@pytest.mark.parametrize("name", TABLES)
def test_a_shipped_policy_plays_the_tables_value(name: str):
    table = json.loads((DATA / f"{TABLES[name]}.json").read_text(encoding="utf-8"))
    played = gacrl.evaluate(f"pretrained:{name}", episodes=table["episodes"])
    for metric, values in values_of(TABLES[name]).items():
        if not metric.startswith("score_"):
            np.testing.assert_allclose(played[metric].mean, values[0], rtol=1e-3, atol=1e-3, err_msg=metric)


@pytest.mark.soak
def test_a_plain_loop_of_mpe2_finds_the_tables_value():
    """320 episodes, summed up here alone: MPE2's own reward, and its landmarks with an agent within 0.1 at the end."""
    policy, env = gacrl.load_policy("pretrained:gacrl"), simple_spread_v3.parallel_env(N=3, max_cycles=25)
    returns, covered = [], []
    for episode in range(320):
        seen, _ = env.reset(seed=700_000 + episode)
        policy.reset(episode)
        earned = 0.0
        while env.agents:
            actions = policy(np.stack([seen[name] for name in env.agents]))
            seen, rewards, *_ = env.step(dict(zip(env.agents, map(int, actions), strict=True)))
            earned += sum(rewards.values()) / 3
        world = env.unwrapped.world
        places = np.stack([agent.state.p_pos for agent in world.agents])
        marks = np.stack([landmark.state.p_pos for landmark in world.landmarks])
        returns.append(earned)
        covered.append((np.linalg.norm(marks[:, None] - places, axis=-1).min(1) < 0.1).mean())
    table = values_of("gacrl-10-seeds-mpe2")
    np.testing.assert_allclose(np.mean(returns), table["return_agent_mean"][0], rtol=1e-3)
    np.testing.assert_allclose(np.mean(covered), table["coverage_final_0.1"][0], atol=2e-3)
