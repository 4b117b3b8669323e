"""Episodes as they happened: recorded from a policy, kept in a file, shown by pictures and the viewer."""

import contextlib
import dataclasses
import io
import os
from collections.abc import Generator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from gacrl import rollout
from gacrl.tasks.spread.environment import CAPTURE_RADIUS, Spread, SpreadParams, unpack_state
from gacrl.types import Channel, Memory, Observation, Policy, PRNGKey, Transition


@dataclass(frozen=True, eq=False)
class Episode:
    """One episode of `spread`, T steps: what the world looked like, what the agents said and did.

    Row t of `positions` and `landmarks` is the world before step t, row T the world at the end. Row t of
    everything else belongs to step t: messages and graph are those of the world in row t. Lengths in arena
    units. Raises ValueError where the arrays do not fit together.
    """

    positions: Float[np.ndarray, "T1 N 2"]
    landmarks: Float[np.ndarray, "T1 L 2"]
    actions: Int[np.ndarray, "T N"] | Float[np.ndarray, "T N A"]
    reward: Float[np.ndarray, "T N"]
    """What the agents earned, as training sees it."""
    reward_raw: Float[np.ndarray, " T"]
    """MPE2's reward at local ratio 0.5, the mean over agents."""
    agent_mask: Bool[np.ndarray, " N"]
    """False for padding, which is never shown."""
    landmark_mask: Bool[np.ndarray, " L"]
    agent_radius: float
    capture_radius: float
    """A landmark with an agent's centre this near is covered."""
    arena_scale: float
    """Everything started within [−arena_scale, arena_scale]²."""
    messages: Float[np.ndarray, "T N V"] | None = None
    """What each agent sent; None where the policy says nothing."""
    adjacency: Bool[np.ndarray, "T N N"] | None = None
    """Entry [t, i, j]: j's message reaches i. None where the policy uses no graph."""

    def __post_init__(self) -> None:
        _check(vars(self))

    @property
    def num_steps(self) -> int:
        """T."""
        return self.reward.shape[0]

    @property
    def covered(self) -> Bool[np.ndarray, "T1 L"]:
        """Which landmarks have an agent within the capture radius; padded ones never do."""
        offsets = self.positions[:, :, None, :] - self.landmarks[:, None, :, :]
        near = np.sqrt(np.square(offsets).sum(-1)) < self.capture_radius
        return (near & self.agent_mask[:, None]).any(1) & self.landmark_mask

    @property
    def coverage(self) -> Float[np.ndarray, " T1"]:
        """The fraction of the landmarks that are covered."""
        return self.covered.sum(1) / max(self.landmark_mask.sum(), 1)

    @property
    def return_so_far(self) -> Float[np.ndarray, " T1"]:
        """The sum of `reward_raw` before each step; the last entry is the metric `return_agent_mean`."""
        return np.concatenate([[0.0], np.cumsum(self.reward_raw, dtype=float)])

    @property
    def symbols(self) -> Int[np.ndarray, "T N"] | None:
        """The most likely symbol of each message; −1 for a message of zeros, which says nothing."""
        if self.messages is None:
            return None
        return np.where(self.messages.any(-1), self.messages.argmax(-1), -1)

    def save(self, path: Path) -> None:
        """Write the episode as an .npz of plain arrays. Raises OSError where the file cannot be written."""
        values = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        with written_whole(path) as file:
            np.savez_compressed(file, **{name: value for name, value in values.items() if value is not None})

    @classmethod
    def load(cls, path: Path) -> "Episode":
        """Read what `save` wrote. Raises ValueError for any other file, OSError for one it cannot read."""
        data = path.read_bytes()
        try:
            return cls(**_read(data))
        except Exception as error:  # numpy and zipfile raise a dozen kinds over a broken file
            reason = " ".join(str(error).split()) or type(error).__name__
            raise ValueError(f"{path} is not a recorded episode: {reason}") from error


_NUMBERS = ("agent_radius", "capture_radius", "arena_scale")
_MASKS = ("agent_mask", "landmark_mask", "adjacency")
_OPTIONAL = ("messages", "adjacency")


def _read(data: bytes) -> dict[str, Any]:
    """The fields of an episode in the bytes of an .npz; arrays that it does not know are left alone."""
    if not data.startswith(b"PK"):
        raise ValueError("it is not an .npz archive")
    fields: dict[str, Any] = {}
    with np.load(io.BytesIO(data), allow_pickle=False) as archive:
        for field in dataclasses.fields(Episode):
            if field.name in archive.files:
                fields[field.name] = archive[field.name]
            elif field.name not in _OPTIONAL:
                raise ValueError(f"{field.name} is missing")
    fields |= {name: float(fields[name].item()) for name in _NUMBERS}
    _check(fields)
    return fields


def _check(fields: Mapping[str, Any]) -> None:
    """Raise ValueError where the fields of an episode do not fit together."""
    steps, agents, landmarks = (len(fields[name]) for name in ("reward", "agent_mask", "landmark_mask"))
    if not steps:
        raise ValueError("an episode has at least one step")
    shapes: dict[str, tuple[int | None, ...]] = {
        "positions": (steps + 1, agents, 2),
        "landmarks": (steps + 1, landmarks, 2),
        "actions": (steps, agents, None) if fields["actions"].ndim == 3 else (steps, agents),
        "reward": (steps, agents),
        "reward_raw": (steps,),
        "agent_mask": (agents,),
        "landmark_mask": (landmarks,),
        "messages": (steps, agents, None),
        "adjacency": (steps, agents, agents),
    }
    for name, shape in shapes.items():
        rows = fields.get(name)
        if rows is None:
            continue
        fits = len(rows.shape) == len(shape) and all(
            wanted in (None, size) for wanted, size in zip(shape, rows.shape, strict=True)
        )
        if not fits:
            raise ValueError(f"{name} of the shape {rows.shape} does not fit the other arrays")
        if (rows.dtype == bool) != (name in _MASKS) or rows.dtype.kind not in "biuf":
            raise ValueError(f"{name} holds {rows.dtype}")
        if not np.isfinite(rows).all():
            raise ValueError(f"{name} holds numbers that are not finite")
    for name in _NUMBERS:
        if not 0 < fields[name] < np.inf:
            raise ValueError(f"{name} must be above 0, not {fields[name]}")


@contextlib.contextmanager
def written_whole(path: Path) -> Generator[BinaryIO]:
    """A file that appears under its name complete, or not at all. Raises OSError."""
    unfinished = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with unfinished.open("wb") as file:
            yield file
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)


def record(
    env: Spread,
    policy: Policy,
    initial_memory: Memory,
    params: SpreadParams,
    key: PRNGKey,
    channel: Channel | None = None,
) -> Episode:
    """One episode, up to its end. For more than one use `record_many`: it compiles once."""
    return record_many(env, policy, initial_memory, params, key, 1, channel)[0]


def record_many(
    env: Spread,
    policy: Policy,
    initial_memory: Memory,
    params: SpreadParams,
    key: PRNGKey,
    num_episodes: int,
    channel: Channel | None = None,
) -> list[Episode]:
    """K episodes, each up to its end: the very episodes that `evaluate` measures with the same arguments."""

    @jax.jit
    def play(memory: Memory, params: SpreadParams, key: PRNGKey, channel: Channel | None) -> _Played:
        def one_step(carry: rollout.Carry, key: PRNGKey) -> tuple[rollout.Carry, tuple[Transition, Array]]:
            carry, step = rollout.step(env, policy, memory, params, carry, key, channel)
            return carry, (step, carry.first)

        start_key, act_key = jax.random.split(key)
        carry = rollout.start(env, params, memory, start_key, num_episodes)
        opening = carry.observation
        _, (steps, done) = jax.lax.scan(one_step, carry, jax.random.split(act_key, env.max_cycles))
        state = jnp.concatenate([_state(opening)[None], _state(steps.next_observation)])
        world = jax.vmap(jax.vmap(lambda packed: unpack_state(packed, env.num_agents)))(state)
        return _Played(
            positions=world.positions,
            landmarks=world.landmarks,
            actions=steps.decision.action,
            messages=steps.decision.message,
            adjacency=steps.decision.adjacency,
            reward=steps.reward,
            reward_raw=steps.info["reward_raw"],
            done=done,
            agent_mask=opening.agent_mask,
            landmark_mask=opening.landmark_mask,
        )

    played = jax.device_get(play(initial_memory, params, key, channel))

    def one(k: int) -> Episode:
        steps = int(played.done[:, k].argmax()) + 1  # the time limit ends what nothing else has ended
        return Episode(
            positions=np.array(played.positions[: steps + 1, k]),
            landmarks=np.array(played.landmarks[: steps + 1, k]),
            actions=np.array(played.actions[:steps, k]),
            messages=None if played.messages is None else np.array(played.messages[:steps, k]),
            adjacency=None if played.adjacency is None else np.array(played.adjacency[:steps, k]),
            reward=np.array(played.reward[:steps, k]),
            reward_raw=np.array(played.reward_raw[:steps, k]),
            agent_mask=np.array(played.agent_mask[k]),
            landmark_mask=np.array(played.landmark_mask[k]),
            agent_radius=float(params.physics.agent_radius),
            capture_radius=CAPTURE_RADIUS,
            arena_scale=float(params.arena_scale),
        )

    return [one(k) for k in range(num_episodes)]


class _Played(NamedTuple):
    """Up to the time limit, episodes side by side; what follows `done` belongs to the next episode."""

    positions: Float[Array, "T1 E N 2"]
    landmarks: Float[Array, "T1 E L 2"]
    actions: Int[Array, "T E N"] | Float[Array, "T E N A"]
    messages: Float[Array, "T E N V"] | None
    adjacency: Bool[Array, "T E N N"] | None
    reward: Float[Array, "T E N"]
    reward_raw: Float[Array, "T E"]
    done: Bool[Array, "T E"]
    agent_mask: Bool[Array, "E N"]
    landmark_mask: Bool[Array, "E L"]


def _state(observation: Observation) -> Float[Array, "*b S"]:
    assert observation.state is not None  # spread always shows it
    return observation.state
