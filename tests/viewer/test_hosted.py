"""Environments that live in Python on the live page: the host plays them, also from the middle of an episode."""

import base64
import io
from typing import Any

import numpy as np
import pytest
from gymnasium.spaces import Box, Discrete
from PIL import Image

import gacrl
from gacrl.errors import UserError
from gacrl.tasks import own
from gacrl.viewer import hosted
from gacrl.viewer.cast import open_cast
from gacrl.viewer.requests import Scene
from gacrl.viewer.show import Show

made: list["Lamps"] = []


class Lamps:
    """Two agents who each turn a lamp brighter or not; the seed says how bright they are at the start."""

    metadata, max_cycles = {"name": "lamps"}, 8

    def __init__(self, render_mode: str | None = None):
        self.possible_agents, self.render_mode, self.unwrapped, self.begun = ["one", "two"], render_mode, self, 0
        made.append(self)

    def observation_space(self, agent: str) -> Box:
        return Box(0, 1, (1,))

    def action_space(self, agent: str) -> Discrete:
        return Discrete(2)

    def reset(self, seed: int | None = None, options: Any = None) -> Any:
        self.begun += 1
        self.agents, self.clock = list(self.possible_agents), 0
        self.light = np.random.default_rng(seed).integers(0, 100, 2)
        return self._seen(), {agent: {} for agent in self.agents}

    def step(self, actions: dict[str, int]) -> Any:
        self.clock += 1
        self.light += np.array([actions.get(agent, 0) for agent in self.possible_agents])
        acting = self.agents
        self.agents = self.possible_agents[:1] if self.clock > 4 else acting  # the second one leaves
        ended = {agent: agent not in self.agents for agent in acting}
        return self._seen(), dict.fromkeys(acting, 1.0), ended, dict.fromkeys(acting, False), {}

    def _seen(self) -> dict[str, np.ndarray]:
        return {agent: np.array([self.light[k] / 255], np.float32) for k, agent in enumerate(self.possible_agents)}

    def render(self) -> np.ndarray | None:
        return None if self.render_mode is None else np.full((4, 6, 3), self.light.sum(), np.uint8)

    def close(self) -> None:
        pass


def light(moment: dict[str, Any]) -> int:
    """How bright the picture of a moment is."""
    return int(np.asarray(Image.open(io.BytesIO(base64.b64decode(moment["drawn"])))).max())


def test_it_is_played_by_the_host_and_what_is_rewound_is_played_again(
    quick_start: None, from_outside: None, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(hosted, "_OPEN", 2)
    own.bring(gacrl.from_pettingzoo(Lamps))
    cast = open_cast(["random"], task="lamps")
    assert (cast.bounds.most, cast.bounds.length, cast.bounds.movable) == (2, 8, False)
    made.clear()
    one, other = Show(cast), Show(cast)
    one.take(Scene(3, 2))
    first = [one.frame(t)["main"] for t in range(9)]
    start = int(np.random.default_rng(3).integers(0, 100, 2).sum())
    gained = np.cumsum(
        [
            0,
            *(
                sum(a for a, there in zip(it["actions"], it["agents"]["there"], strict=True) if there)
                for it in first[:8]
            ),
        ]
    )
    assert [light(it) for it in first] == (start + gained).tolist() and gained[8] > 0
    assert [sum(it["agents"]["there"]) for it in first] == [2] * 5 + [1] * 4
    assert (first[8]["over"], first[8]["earned"]) == (True, 8.0) and not first[7]["over"]
    del one.main.moments[3:]  # as after a change in step 3
    other.take(Scene(4, 2))
    assert light(other.frame(2)["main"]) >= int(np.random.default_rng(4).integers(0, 100, 2).sum())
    begun = sum(env.begun for env in made)
    assert [one.frame(t)["main"] for t in range(9)] == first, "what was done is done again"
    assert sum(env.begun for env in made) == begun + 1 and len(made) <= 2


def test_one_that_draws_nothing_is_refused_in_a_sentence(quick_start: None, from_outside: None):
    def unseen() -> Lamps:
        return Lamps()

    own.bring(gacrl.from_pettingzoo(unseen, name="dark"))
    with pytest.raises(UserError, match="draws no picture of itself.*rgb_array"):
        open_cast(["random"], task="dark")
