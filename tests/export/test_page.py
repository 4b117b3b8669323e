"""The exported page: its physics and networks are JAX's, it is whole, and nothing that a run says can end up as code."""

import json
import shutil
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gacrl import play, rollout
from gacrl.export import bundle, portable
from gacrl.training.devices import one_seed

NODE = shutil.which("node")
STEPS = 1_000
TOLERANCE = 1e-4
HERE = Path(__file__).parent


@dataclass(frozen=True)
class Live:
    """A policy, its rules, and its weights as the page has them."""

    run: play.TrainedRun
    world: dict[str, Any]
    network: dict[str, Any]


def live(name: str, **settings: Any) -> Live:
    from gacrl.config import files as configuration

    run = play.open_run(name, lambda trained: configuration.changed(trained, settings))
    world, network = run.task.world(run.env, run.trainer.evaluation_params), portable.network(run)
    assert network is not None
    return Live(run, world, network)


def recorded(it: Live, num_envs: int = 40) -> dict[str, Any]:
    """At least 1,000 steps in which every other action is random, so that states are those of no policy."""
    run, params = it.run, it.run.trainer.evaluation_params
    env, length = run.env, -(-STEPS // num_envs)
    agent = run.trainer.algorithm.network(one_seed(run.learners, 0))

    @jax.jit
    def steps(key: jax.Array) -> Any:
        def one(carry: rollout.Carry, key: jax.Array):
            keys, mix_key = jax.random.split(key, num_envs), jax.random.fold_in(key, 1)
            output, _ = jax.vmap(lambda seen: agent(seen))(carry.observation)
            available = carry.observation.action_mask
            best = jnp.where(available, output.head, -jnp.inf).argmax(-1)
            anything = jax.random.categorical(mix_key, jnp.where(available, 0.0, -jnp.inf))
            wild = jnp.where(jnp.arange(num_envs)[:, None] % 2 == 0, best, anything)
            state, after = jax.vmap(env.step, (0, 0, 0, None))(carry.env_state, wild, keys, params)
            told = (carry.env_state, output, best, wild, state, after.info)
            return carry._replace(env_state=state, observation=after.observation), told

        carry = rollout.start(env, params, (), key, num_envs)
        return jax.lax.scan(one, carry, jax.random.split(key, length))[1]

    played = jax.device_get(jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), steps(jax.random.key(7))))
    return {"world": it.world, "network": it.network, "steps": [_plain(it.world, played, k) for k in range(STEPS)]}


def _plain(world: dict[str, Any], played: Any, k: int) -> dict[str, Any]:
    before, output, best, wild, after, info = jax.tree.map(lambda leaf: leaf[k], played)
    state = {name: np.ravel(getattr(before, name)).tolist() for name in ("positions", "velocities", "landmarks")}
    if hasattr(before, "goals"):
        state |= {"goals": before.goals.tolist(), "order": before.order.tolist()}
    measures = {name: float(info[measure]) for name, measure in world["measures"].items()}
    places = {name: np.ravel(getattr(after, name)).tolist() for name in ("positions", "velocities")}
    return {
        "state": state,
        "values": np.ravel(output.head).tolist(),
        "words": np.ravel(output.messages.argmax(-1)).tolist(),
        "best": best.tolist(),
        "actions": wild.tolist(),
        "hears": [np.flatnonzero(row).tolist() for row in output.adjacency],
        "after": {**places, "reward": float(info["reward_raw"]), "collisions": 0.0, **measures},
    }


def in_node(folder: Path, data: dict[str, Any]) -> dict[str, Any]:
    (folder / "recorded.json").write_text(json.dumps(data))
    (folder / "parity.mjs").write_text(bundle.script("parity.js", {"parity.js": (HERE / "parity.js").read_text()}))
    command = [str(NODE), "parity.mjs", "recorded.json"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.skipif(NODE is None, reason="the page's JavaScript is compared with JAX in node, and there is none")
@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("pretrained:gacrl", {}),
        ("pretrained:gacrl-teams", {"num_agents": 16, "arena_scale": 1.5}),
        ("pretrained:gacrl-reference", {}),
        ("pretrained:gacrl-colours", {}),
    ],
)
def test_physics_and_policy_are_those_of_jax(tmp_path: Path, quick_start: Any, name: str, settings: dict[str, Any]):
    found = in_node(tmp_path, recorded(live(name, **settings)))
    assert found["steps"] == STEPS
    assert max(found["worst"].values()) < TOLERANCE, found
    assert found["wrong"] == {"words": 0, "actions": 0, "edges": 0}
