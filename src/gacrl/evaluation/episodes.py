"""Episodes as they happened: recorded from a policy, kept in a file, shown by pictures and the viewer."""

import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8

from gacrl import rollout
from gacrl.envs.environment import Environment, EnvParams, EnvState, typed_keys
from gacrl.envs.hosted import Copies, Hosted
from gacrl.evaluation import on_host
from gacrl.replacing import replaced
from gacrl.scene import Discs, Scene, compose, discs
from gacrl.types import Intervention, Memory, Observation, Policy, PRNGKey, Transition

Look: TypeAlias = Callable[[EnvState, EnvParams], Scene]
"""What there is to see of a state: a task's scene, its settings given."""


@dataclass(frozen=True, eq=False)
class Episode:
    """One episode, T steps: what the world looked like, what the agents said and did.

    Row t of the scene is the world before step t, row T the world at the end. Row t of everything else belongs to step
    t: messages and graph are those of the world in row t. Raises ValueError where the arrays do not fit together.
    """

    actions: Int[np.ndarray, "T N"] | Float[np.ndarray, "T N A"]
    reward: Float[np.ndarray, "T N"]
    """What the agents earned, as training sees it."""
    reward_raw: Float[np.ndarray, " T"]
    """What the metric `return_agent_mean` sums."""
    agent_mask: Bool[np.ndarray, "T N"]
    """False for agents that are not there."""
    scene: Scene | None = None
    """Of NumPy arrays, T + 1 rows in each; None where there is nothing to see."""
    messages: Float[np.ndarray, "T R N V"] | None = None
    """What each agent sent in each round; None where the policy says nothing."""
    adjacency: Bool[np.ndarray, "T N N"] | None = None
    """Entry [t, i, j]: j's message reaches i. None where the policy uses no graph."""
    frames: UInt8[np.ndarray, "T1 height width 3"] | None = None
    """The environment's own pictures, where it draws them; rows as in a scene."""

    def __post_init__(self) -> None:
        _check(_flat(self))

    @property
    def num_steps(self) -> int:
        """T."""
        return self.reward.shape[0]

    @property
    def visible(self) -> bool:
        """Whether there is something to see."""
        return self.scene is not None or self.frames is not None

    @property
    def return_so_far(self) -> Float[np.ndarray, " T1"]:
        """The sum of `reward_raw` before each step; the last entry is the metric `return_agent_mean`."""
        return np.concatenate([[0.0], np.cumsum(self.reward_raw, dtype=float)])

    @property
    def symbols(self) -> Int[np.ndarray, "T R N"] | None:
        """Return the most likely symbol of each message; −1 for one that says nothing or is not made of symbols."""
        return None if self.messages is None else said_symbols(self.messages)

    def save(self, path: Path) -> None:
        """Write the episode as an .npz of plain arrays. Raises OSError where the file cannot be written."""
        with replaced(path) as file:
            np.savez_compressed(file, allow_pickle=False, **_flat(self))

    @classmethod
    def load(cls, path: Path) -> "Episode":
        """Read what `save` wrote. Raises ValueError for any other file, OSError for one it cannot read."""
        data = path.read_bytes()
        try:
            return _read(data)
        except Exception as error:  # numpy and zipfile raise a dozen kinds over a broken file
            reason = " ".join(str(error).split()) or type(error).__name__
            raise ValueError(f"{path} is not a recorded episode: {reason}") from error


def said_symbols(messages: Float[np.ndarray, "*b V"]) -> Int[np.ndarray, "*b"]:
    """Return the most likely symbol of each message; −1 for one that says nothing or is not made of symbols."""
    distribution = (messages >= 0).all(-1) & (np.abs(messages.sum(-1) - 1) < 1e-3)
    return np.where(distribution, messages.argmax(-1), -1)


_REQUIRED = ("actions", "reward", "reward_raw", "agent_mask")
_OPTIONAL = ("messages", "adjacency", "frames")
_DISCS = tuple(f"scene.{group}.{part}" for group in ("agents", "marks") for part in Discs._fields)
_SCENE = (*_DISCS, "scene.lines", "scene.ground")
_MASKS = ("agent_mask", "adjacency", *(name for name in _SCENE if name.endswith((".there", ".lit"))))


def _flat(episode: Episode) -> dict[str, np.ndarray]:
    """The arrays of an episode by name."""
    arrays = {name: getattr(episode, name) for name in (*_REQUIRED, *_OPTIONAL)}
    if episode.scene is not None:
        groups = {"agents": episode.scene.agents, "marks": episode.scene.marks}
        arrays |= {f"scene.{g}.{part}": array for g, it in groups.items() for part, array in it._asdict().items()}
        arrays |= {"scene.lines": episode.scene.lines, "scene.ground": episode.scene.ground}
    return {name: array for name, array in arrays.items() if array is not None}


def _read(data: bytes) -> Episode:
    """The episode in the bytes of an .npz; arrays that it does not know are left alone."""
    if not data.startswith(b"PK"):
        raise ValueError("it is not an .npz archive")
    with np.load(io.BytesIO(data), allow_pickle=False) as archive:
        seen = any(name in archive.files for name in _SCENE)
        for name in (*_REQUIRED, *(_SCENE if seen else ())):
            if name not in archive.files:
                raise ValueError(f"{name} is missing")
        arrays = {name: archive[name] for name in (*_REQUIRED, *_OPTIONAL, *_SCENE) if name in archive.files}
    _check(arrays)
    scene = None
    if seen:
        agents, marks = (
            Discs(*(arrays[f"scene.{group}.{part}"] for part in Discs._fields)) for group in ("agents", "marks")
        )
        scene = Scene(agents, marks, arrays["scene.lines"], arrays["scene.ground"])
    plain = {name: arrays[name] for name in (*_REQUIRED, *_OPTIONAL) if name in arrays}
    return Episode(**plain, scene=scene)


def _check(arrays: Mapping[str, np.ndarray]) -> None:
    """Raise ValueError where the arrays of an episode do not fit together."""
    steps, agents = np.shape(arrays["reward"])[:1] + np.shape(arrays["agent_mask"])[1:2]
    if not steps:
        raise ValueError("an episode has at least one step")
    marks = arrays["scene.marks.radius"].shape[-1] if "scene.marks.radius" in arrays else 0
    disc: dict[str, tuple[int | None, ...]] = {
        "positions": (2,),
        "radius": (),
        "there": (),
        "lit": (),
        "colour": (),
    }
    counts = {"agents": agents, "marks": marks}
    shapes: dict[str, tuple[int | None, ...]] = {
        "actions": (steps, agents, None) if arrays["actions"].ndim == 3 else (steps, agents),
        "reward": (steps, agents),
        "reward_raw": (steps,),
        "agent_mask": (steps, agents),
        "messages": (steps, None, agents, None),
        "adjacency": (steps, agents, agents),
        "frames": (steps + 1, None, None, 3),
        **{f"scene.{g}.{part}": (steps + 1, n, *rest) for g, n in counts.items() for part, rest in disc.items()},
        "scene.lines": (steps + 1, None, 2, 2),
        "scene.ground": (steps + 1, 2, 2),
    }
    for name, rows in arrays.items():
        shape = shapes[name]
        fits = len(rows.shape) == len(shape) and all(
            wanted in (None, size) for wanted, size in zip(shape, rows.shape, strict=True)
        )
        if not fits:
            raise ValueError(f"{name} of the shape {rows.shape} does not fit the other arrays")
        if (rows.dtype == bool) != (name in _MASKS) or rows.dtype.kind not in "biuf":
            raise ValueError(f"{name} holds {rows.dtype}")
        if not np.isfinite(rows).all():
            raise ValueError(f"{name} holds numbers that are not finite")
        if name.endswith(".radius") and (rows < 0).any():
            raise ValueError(f"{name} must not be below 0")


def recorded_bytes(env: Environment, params: EnvParams, num_episodes: int, look: Look | None = None) -> int:
    """Return the memory that recorded episodes take at the least: what is seen and earned in every step up to the time
    limit.

    Counted from shapes: nothing is played.
    """
    state, seen = jax.eval_shape(env.reset, jax.random.key(0), params)
    scene = None if look is None else jax.eval_shape(look, state, params)
    places = seen.positions if scene is None else scene
    shown = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves((places, seen.agent_mask)))
    agents, single = env.num_agents, np.dtype(np.float32).itemsize
    acted = single * agents * (env.num_actions if env.continuous_actions else 1)
    heard = agents**2  # who hears whom, a byte for each pair
    return int(env.max_cycles) * num_episodes * (shown + acted + heard + single * agents)


class Played(NamedTuple):
    """Up to the time limit, episodes side by side; what follows `done` belongs to the next episode."""

    scene: Scene | None
    actions: Int[Array, "T E N"] | Float[Array, "T E N A"]
    messages: Float[Array, "T E R N V"] | None
    adjacency: Bool[Array, "T E N N"] | None
    reward: Float[Array, "T E N"]
    reward_raw: Float[Array, "T E"]
    done: Bool[Array, "T E"]
    agent_mask: Bool[Array, "T E N"]


def record_many(
    env: Environment,
    policy: Policy,
    initial_memory: Memory,
    params: EnvParams,
    key: PRNGKey,
    num_episodes: int,
    intervention: Intervention | None = None,
    look: Look | None = None,
    pictures: bool = True,
) -> list[Episode]:
    """Record K episodes, each up to its end: the very episodes that `evaluate` measures with the same arguments.

    look: what is to be seen of a state; without it discs, where the task says where its agents are. An environment that
    lives in Python draws its own pictures, unless nobody wants `pictures`.
    """
    if isinstance(env, Hosted):
        playing = on_host.actors(env, policy, initial_memory, intervention)
        return _record_on_host(env, playing, key, num_episodes, pictures)

    @jax.jit
    def program(memory: Memory, params: EnvParams, key: PRNGKey) -> Played:
        return play(env, policy, memory, params, key, num_episodes, intervention, look)

    return cut(program(initial_memory, params, typed_keys(key)))


def play(
    env: Environment,
    policy: Policy,
    memory: Memory,
    params: EnvParams,
    key: PRNGKey,
    num_episodes: int,
    intervention: Intervention | None = None,
    look: Look | None = None,
) -> Played:
    """Play what `record_many` compiles: K environments from their start to the time limit."""

    def one_step(
        carry: rollout.Carry, key: PRNGKey
    ) -> tuple[rollout.Carry, tuple[Transition, Array, Scene | None]]:
        keys = jax.random.split(key, (num_episodes, 3))
        after, step = rollout.act(env, policy, params, carry, keys, intervention)
        seen = seen_of(look, after.env_state, step.next_observation, params)
        return rollout.renew(env, memory, params, after, step.left, keys), (step, after.first, seen)

    start_key, act_key = jax.random.split(key)
    carry = rollout.start(env, params, memory, start_key, num_episodes, intervention, policy)
    opening = seen_of(look, carry.env_state, carry.observation, params)
    _, (steps, done, seen) = jax.lax.scan(one_step, carry, jax.random.split(act_key, env.max_cycles))
    scene = jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), opening, seen)
    return _played(steps, done, scene)


def cut(played: Played) -> list[Episode]:
    """Return what was played side by side as episodes, each up to its end."""
    played = jax.device_get(played)
    return [_episode(played, k) for k in range(played.done.shape[1])]


def _played(steps: Transition, done: Bool[Array, "T E"], scene: Scene | None = None) -> Played:
    return Played(
        scene=scene,
        actions=steps.decision.action,
        messages=steps.decision.messages,
        adjacency=steps.decision.adjacency,
        reward=steps.reward,
        reward_raw=steps.info["reward_raw"],
        done=done,
        agent_mask=steps.observation.agent_mask,
    )


_FRAMES_BYTES = 256 * 2**20
"""Of all pictures that environments draw, at most."""
_FRAMES_WIDTH = 480


def _record_on_host(
    env: Hosted, playing: on_host.Actors, key: PRNGKey, num_episodes: int, pictures: bool
) -> list[Episode]:
    """The same, of an environment that lives in Python, with the pictures that it draws."""
    room = _FRAMES_BYTES / (num_episodes * (env.max_cycles + 1))
    width = min(_FRAMES_WIDTH, int((room / 3) ** 0.5))
    recorded: list[Episode] = []
    for episodes in on_host.batches(num_episodes):
        frames: list[Any] = []

        def look(copies: Copies, frames: list[Any] = frames) -> None:
            frames.append(copies.pictures(width))

        moments = list(on_host.play(env, playing, key, episodes, look if pictures else None))
        steps = rollout.happened(
            *_stacked([(moment.decided, moment.decision, moment.after) for moment in moments])
        )
        played = jax.device_get(_played(steps, steps.terminated | steps.truncated))
        for k in range(len(episodes)):
            episode = _episode(played, k)
            shown = [moment[k] for moment in frames[: episode.num_steps + 1] if moment is not None]
            recorded.append(replace(episode, frames=np.stack(shown) if shown else None))
    return recorded[:num_episodes]


@jax.jit
def _stacked(steps: list[Any]) -> Any:
    return jax.tree.map(lambda *rows: jnp.stack(rows), *steps)


def seen_of(look: Look | None, state: EnvState, observation: Observation, params: EnvParams) -> Scene | None:
    """Return what is to be seen of each environment [E, …]: discs where nobody says how to look."""
    if look is not None:
        return jax.vmap(look, (0, None))(state, params)
    if observation.positions is None:
        return None
    return jax.vmap(lambda place, there: compose(discs(place, 0.0, there)))(
        observation.positions, observation.agent_mask
    )


def _episode(played: Played, k: int) -> Episode:
    """Cut the k-th of the episodes that were played side by side, up to its end."""
    steps = int(played.done[:, k].argmax()) + 1  # the time limit ends what nothing else has ended

    def rows(array: Any, count: int = steps) -> np.ndarray | None:
        return None if array is None else np.array(array[:count, k])

    return Episode(
        actions=np.array(played.actions[:steps, k]),
        messages=rows(played.messages),
        adjacency=rows(played.adjacency),
        reward=np.array(played.reward[:steps, k]),
        reward_raw=np.array(played.reward_raw[:steps, k]),
        agent_mask=np.array(played.agent_mask[:steps, k]),
        scene=sized(jax.tree.map(lambda leaf: rows(leaf, steps + 1), played.scene)),
    )


def sized(scene: Scene | None) -> Scene | None:
    """Give agents without a radius one that suits the picture: a twentieth of the way that all of them cover."""
    if scene is None or scene.agents.radius.any():
        return scene
    places = scene.agents.positions.reshape(-1, 2)
    size = max(float(np.ptp(places, axis=0).max(initial=0.0)), 1e-6) / 20
    return scene._replace(agents=scene.agents._replace(radius=np.full_like(scene.agents.radius, size)))
