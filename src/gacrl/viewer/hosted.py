"""A policy in an environment that lives in Python: the host steps it, and its state is what was done in it.

Nobody can put such an environment back to an earlier step. So a state is an episode's seed and its actions, and an
environment that stands elsewhere begins anew and repeats them: what is rewound is played again, for environments that
do for a seed what they did before.
"""

import base64
import io
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, UInt8

from gacrl.envs.environment import EnvParams
from gacrl.envs.hosted import Copies, Hosted
from gacrl.errors import UserError
from gacrl.networks.memory import restarted
from gacrl.scene import Edit, Scene, compose, discs
from gacrl.types import Learner, Memory, Observation
from gacrl.viewer.rooms import Customs, Decided, Happened, Meddling, Playable, Room, Stood

WIDTH = 360
"""Pixels of a picture, at most."""
_OPEN = 12
"""Environments that are open at once: those of the visitors who wait longest begin anew."""
_ROW = -1.25
"""Where agents stand in a row, below the environment's own picture: nobody knows where they are in it."""


class Past(NamedTuple):
    """What was done in an episode so far."""

    seed: int
    actions: tuple[np.ndarray, ...]
    there: Bool[np.ndarray, " N"]
    drawn: str
    """What the environment draws of it: a PNG file in base64."""


class HostRoom:
    """What `Room` is, for a hosted environment. Raises UserError for one that draws nothing, and Faulty."""

    def __init__(self, playable: Playable, customs: Customs) -> None:
        assert isinstance(playable.env, Hosted)
        self._env, self._inner = playable.env, Room(playable, customs._replace(look=_row, edit=None, join=None))
        self._open: list[tuple[Past, Copies]] = []
        self._forget = jax.jit(restarted)
        self.places, self.marks, self.memory = self._inner.places, 0, self._inner.memory
        self.words: tuple[int, int, int] | None = None
        """[R, N, V] of what is said in a step; None for a policy that says nothing."""

    def reset(self, params: EnvParams, seed: int) -> Stood:
        """Begin an episode."""
        copies = self._free()
        return self._stood(copies, seed, (), copies.begin([0], [seed]), self.memory, True)

    def step(self, params: EnvParams, state: Past, decided: Decided, seed: int, t: int) -> tuple[Stood, Happened]:
        """Step, by what was decided in step t."""
        copies, action = self._standing_at(state), np.asarray(decided.action)
        after = copies.step(action[None])
        memory = decided.memory
        if np.any(after.left):
            memory = self._forget(self.memory, memory, np.asarray(after.left)[0])
        over = np.asarray(after.terminated | after.truncated)[0]
        told = Happened(after.info["reward_raw"][0], {}, over)
        return self._stood(copies, state.seed, (*state.actions, action), after.observation, memory, False), told

    def edited(self, params: EnvParams, stood: Stood, hand: Edit) -> Stood:
        """Let a hand move nothing."""
        return stood

    def joined(self, params: EnvParams, state: Past, before: int, now: int, seed: int, t: int) -> Stood:
        """Refuse: raises AssertionError, since nobody comes or goes."""
        raise AssertionError("no hosted task has a team")

    def decide(
        self, learner: Learner, params: EnvParams, stood: Stood, seed: int, t: int, meddling: Meddling | None
    ) -> Decided:
        """Let the agents decide in step t."""
        inside = stood._replace(state=jnp.asarray(stood.state.there))
        return self._inner.decide(learner, params, inside, seed, t, meddling)

    def drawn(self, state: Past) -> str:
        """Return what the environment draws."""
        return state.drawn

    def measure(self, learner: Learner, params: EnvParams) -> None:
        """Find out how much there is to hear."""
        stood = self.reset(params, 0)
        found = jax.eval_shape(lambda: self.decide(learner, params, stood, 0, 0, None))
        self.words = None if found.messages is None else found.messages.shape

    def warm(self, learner: Learner, params: EnvParams) -> Any:
        """Compile what decides."""
        stood = self.reset(params, 0)
        self.decide(learner, params, stood, 0, 0, None)
        yield
        if self.words is not None:
            self.decide(learner, params, stood, 0, 1, Meddling.none(self.words))

    def _stood(
        self,
        copies: Copies,
        seed: int,
        actions: tuple[np.ndarray, ...],
        seen: Observation,
        memory: Memory,
        first: bool,
    ) -> Stood:
        one = jax.tree.map(lambda leaf: np.array(leaf[0]), seen)
        pictures = copies.pictures(WIDTH)
        if not pictures:
            raise UserError(
                f"{type(self._env).__name__} draws no picture of itself, and a page would have nothing to show: "
                "give it a render_mode 'rgb_array'"
            )
        past = Past(seed, actions, one.agent_mask, _encoded(pictures[0]))
        self._open.append((past, copies))
        return Stood(past, one, memory, first)

    def _standing_at(self, past: Past) -> Copies:
        """Return an environment in which just this was done."""
        for place, (there, copies) in enumerate(self._open):
            if there is past:
                del self._open[place]
                return copies
        copies = self._free()
        copies.begin([0], [past.seed])
        for action in past.actions:
            copies.step(action[None])
        return copies

    def _free(self) -> Copies:
        return self._env.open(1, True) if len(self._open) < _OPEN else self._open.pop(0)[1]


def _row(there: Bool[Array, " N"], params: EnvParams) -> Scene:
    """Put agents into a row below a picture."""
    count = there.shape[0]
    places = jnp.stack([(jnp.arange(count) + 0.5) / count * 2 - 1, jnp.full(count, _ROW)], axis=1)
    return compose(discs(places, min(0.12, 0.7 / count), there), ground=jnp.asarray([[-1.0, -1.0], [1.0, 1.0]]))


def _encoded(picture: UInt8[np.ndarray, "height width 3"]) -> str:
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(picture).save(file, "PNG")
    return base64.b64encode(file.getvalue()).decode()
