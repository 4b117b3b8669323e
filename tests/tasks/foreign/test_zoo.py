"""PettingZoo's environments as arrays of a team, and a sentence for each thing that they must not do."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete

import gacrl
from gacrl.envs.hosted import Copies
from gacrl.errors import Faulty
from gacrl.tasks import own
from gacrl.tasks.foreign.layout import lay_out

SEEN = {
    "guard_0": Box(-1, 1, (2, 2)),
    "guard_1": Box(-1, 1, (2, 2)),
    "thief_0": Box(-1, 1, (3,)),
    "crowd": Box(0, 1, (1,)),
}
DOES = {
    "guard_0": Discrete(3, start=2),
    "guard_1": Discrete(3, start=2),
    "thief_0": MultiDiscrete([2, 3]),
    "crowd": Discrete(9),
}


class Town:
    """Four agents who see and do different things. The second guard dies in step 2, the thief is caught in step 4.

    A test changes what it hands out: `bend` gets the step's number and its five dictionaries.
    """

    def __init__(self, bend: Callable[..., None] = lambda step, *handed: None, max_cycles: int = 6):
        self.possible_agents, self.bend, self.max_cycles = list(SEEN), bend, max_cycles
        self.metadata, self.render_mode, self.unwrapped = {"name": "town"}, None, self
        self.taken: list[dict[str, Any]] = []

    def observation_space(self, agent: str) -> Any:
        return SEEN[agent]

    def action_space(self, agent: str) -> Any:
        return DOES[agent]

    def reset(self, seed: int | None = None, options: Any = None) -> Any:
        self.clock, self.agents = 0, list(self.possible_agents)
        handed = self._handed(self.agents)
        self.bend(self, 0, *handed)
        return handed[0], handed[4]

    def step(self, actions: dict[str, Any]) -> Any:
        self.taken.append(actions)
        self.clock += 1
        agents, ends = self.agents, {2: ["guard_1"], 4: ["thief_0"]}.get(self.clock, [])
        handed = self._handed(agents)
        for agent in ends:
            handed[2][agent] = True
        self.agents = [agent for agent in agents if agent not in ends]
        self.bend(self, self.clock, *handed)
        return handed

    def _handed(self, agents: list[str]) -> tuple[dict[str, Any], ...]:
        seen = {agent: np.full(SEEN[agent].shape, 0.1 * self.clock, np.float32) for agent in agents}
        rewards = {agent: float(i + self.clock) for i, agent in enumerate(agents)}
        infos: dict[str, Any] = {agent: {} for agent in agents}
        infos["guard_0"]["action_mask"] = np.array([1, 1, self.clock != 1], np.int8)
        return seen, rewards, dict.fromkeys(agents, False), dict.fromkeys(agents, False), infos

    def close(self) -> None:
        pass


def opened(bend: Callable[..., None] = lambda *handed: None, **settings: Any) -> tuple[Any, Copies, list[Town]]:
    made: list[Town] = []

    def make() -> Town:
        made.append(Town(bend))
        return made[-1]

    task = gacrl.from_pettingzoo(make, scripted={"crowd": lambda seen: round(10 * float(seen[0]))}, **settings)
    env = task.make(task.settings())
    made.clear()
    return env, env.open(2), made


def test_agents_are_padded_masked_and_told_apart_and_may_die():
    env, copies, (first, second) = opened()
    assert (env.num_agents, env.num_actions, env.observation_size, env.max_cycles) == (3, 6, 4 + 2, 6)
    seen = copies.begin([0, 1], [5, 6])
    roles = [[1, 0], [1, 0], [0, 1]]
    np.testing.assert_array_equal(seen.features[1], np.hstack([np.zeros((3, 4)), roles]))
    np.testing.assert_array_equal(seen.action_mask[0].sum(1), [3, 3, 6])
    steps = [copies.step(np.array([[0, 1, 4], [2, 0, 5]])) for _ in range(6)]
    acted = first.taken[0]
    assert (acted["guard_0"], acted["guard_1"], acted["crowd"]) == (2, 3, 0) and acted["thief_0"].tolist() == [
        1,
        1,
    ]
    assert [sorted(actions) for actions in second.taken[1::2]] == [
        ["crowd", "guard_0", "guard_1", "thief_0"],
        ["crowd", "guard_0", "thief_0"],
        ["crowd", "guard_0"],
    ]
    assert first.taken[3]["crowd"] == 3, "a script sees what the step before showed"
    np.testing.assert_array_equal(
        [step.left[0] for step in steps[:4]], [[0, 0, 0], [0, 1, 0], [0, 0, 0], [0, 0, 1]]
    )
    there = [step.observation.agent_mask[0].tolist() for step in steps]
    assert there == [[True] * 3, *[[True, False, True]] * 2, *[[True, False, False]] * 3]
    row = np.float32(0.3)
    np.testing.assert_array_equal(steps[2].observation.features[0, :, :4], [[row] * 4, [0] * 4, [row] * 3 + [0]])
    assert steps[0].observation.action_mask[0, 0].tolist() == [True, True, False, False, False, False]
    np.testing.assert_array_equal(steps[1].reward[0], [2, 3, 4])
    np.testing.assert_array_equal(steps[2].reward[0], [3, 0, 4])
    np.testing.assert_array_equal([step.info["reward_raw"][0] for step in steps], [2, 3, 3.5, 4.5, 5, 6])
    assert [(step.terminated[0], step.truncated[0]) for step in steps] == [(False, False)] * 5 + [(False, True)]
    assert steps[0].observation.features is not steps[1].observation.features, "what is handed out stays"


def test_boxes_of_two_sizes_are_shares_between_their_bounds():
    boxes = {"arm": Box(np.float32([[-1], [2]]), np.float32([[3], [4]])), "leg": Box(1, 5, (1,), np.float64)}
    layout = lay_out("robot", list(boxes), dict.fromkeys(boxes, Box(0, 1, (3,))), boxes)
    assert layout.continuous and layout.mask.tolist() == [[True, True], [True, False]]
    arm, leg = layout.action(0, [0.25, 1.0]), layout.action(1, [0.5, 0.9])
    np.testing.assert_array_equal(arm, np.array([[0.0], [4.0]], np.float32))
    assert arm.dtype == np.float32 and leg.dtype == np.float64 and leg.tolist() == [3.0]
    assert all(boxes[name].contains(action) for name, action in (("arm", arm), ("leg", leg)))
    # The numbers nearest to 0: 0 and 2 of the arm, 1 of the leg.
    assert [acts.idle().tolist() for acts in layout.acts] == [[0.25, 0.0], [0.0]]


def test_an_episode_ends_with_the_last_of_those_who_learn():
    """Terminated where all of them were, truncated where one was; whoever was terminated then has no future."""

    def all_end(
        town: Town, step: int, seen: Any, rewards: Any, terminated: Any, truncated: Any, infos: Any
    ) -> None:
        if step == 3:
            terminated["guard_0"], terminated["thief_0"], town.agents = True, not town.cut, ["crowd"]
            truncated["thief_0"] = town.cut

    for cut in (False, True):
        _, copies, towns = opened(all_end)
        for town in towns:
            town.cut = cut  # pyright: ignore[reportAttributeAccessIssue]
        copies.begin([0, 1])
        step = [copies.step(np.zeros((2, 3), int)) for _ in range(3)][-1]
        assert (step.terminated[1], step.truncated[1]) == (not cut, cut)
        assert step.left[1].tolist() == [cut, False, False]
        again = copies.begin([1])
        assert again.agent_mask.tolist() == [[True, False, True], [True, True, True]], "the other one stays ended"


def number(what: str, value: Any, at: int = 3, who: str = "thief_0") -> Callable[..., None]:
    """Hand out this in step `at`; `None` leaves the agent out."""
    names = ("seen", "rewards", "terminated", "truncated", "infos")

    def bend(town: Town, step: int, *handed: dict[str, Any]) -> None:
        if step == at:
            handed[names.index(what)][who] = value
            if value is None:
                del handed[names.index(what)][who]

    return bend


def late(town: Town, step: int, *handed: Any) -> None:
    if step == 3:
        town.agents = [*town.agents, "guard_1"]


def gone(town: Town, step: int, *handed: Any) -> None:
    if step == 1:
        town.agents = ["guard_0", "crowd"]


def raises(town: Town, step: int, *handed: Any) -> None:
    if step == 2:
        raise KeyError("lamp")


@pytest.mark.parametrize(
    ("bend", "sentence"),
    [
        (number("seen", np.zeros(4)), "thief_0 of town saw the shape [4], and its space says [3], in step 3"),
        (number("seen", np.array([0, np.nan, 0])), "thief_0 of town saw a number that is not finite, in step 3"),
        (number("seen", None, at=0), "thief_0 of town was shown nothing, as an episode began"),
        (number("rewards", float("inf")), "thief_0 of town got a reward that is not finite, inf, in step 3"),
        (number("rewards", "much"), "thief_0 of town got the reward 'much', which is no number"),
        (number("rewards", None), "thief_0 of town got no reward, in step 3"),
        (number("truncated", None), "thief_0 of town was not told whether its episode is over"),
        (number("infos", {"action_mask": [0] * 6}), "an action mask that allows none of its 6 actions, in step 3"),
        (
            late,
            "guard_1 of town came after the episode had begun: agents may leave early, not come late, in step 3",
        ),
        (gone, "guard_1 of town is gone, and was neither terminated nor truncated, in step 1"),
        (raises, "town raised KeyError in step, after 1 steps of an episode: 'lamp'; mend the environment"),
    ],
)
def test_what_an_environment_must_not_hand_out_is_named(bend: Callable[..., None], sentence: str):
    _, copies, _ = opened(bend)

    def play() -> None:
        copies.begin([0, 1])
        for _ in range(3):
            copies.step(np.zeros((2, 3), int))

    with pytest.raises(Faulty) as error:
        play()
    assert sentence in str(error.value)


def shows(space: Any, does: Any = None) -> Any:
    """A town in which the thief sees and does this."""

    class Other(Town):
        def observation_space(self, agent: str) -> Any:
            return space if agent == "thief_0" else SEEN[agent]

        def action_space(self, agent: str) -> Any:
            return (does or Discrete(2)) if agent == "thief_0" else DOES[agent]

    return Other


def endless() -> Town:
    town = Town()
    del town.max_cycles
    return town


def turn_based() -> Any:
    from mpe2 import simple_tag_v3

    return simple_tag_v3.env()


@pytest.mark.parametrize(
    ("make", "settings", "sentence"),
    [
        (
            turn_based,
            {},
            "turn-based (AEC), and gacrl's agents act at once: wrap it by pettingzoo.utils.conversions.aec_to",
        ),
        (shows(Dict({"a": SEEN["crowd"]})), {}, "thief_0 of town sees a Dict, and gacrl reads vectors (Box)"),
        (shows(Box(0, 255, (8, 8, 3), np.uint8)), {}, "thief_0 of town sees an image of the shape [8, 8, 3]"),
        (shows(SEEN["crowd"], Box(-1, 1, (2,))), {}, "thief_0 of town acts by a Box and guard_0 by a Discrete"),
        (shows(SEEN["crowd"], Box(-np.inf, 1, (2,))), {}, "thief_0 of town acts by a Box without bounds"),
        (shows(SEEN["crowd"], Dict({"a": DOES["crowd"]})), {}, "thief_0 of town acts by a Dict: gacrl's agents"),
        (shows(SEEN["crowd"], MultiBinary(7)), {}, "has 128 actions, 2 × 2 × 2 × 2 × 2 × 2 × 2, and at most 64"),
        (endless, {}, "town does not say how long an episode is: give max_cycles"),
        (Town, {"max_cycles": 0}, "max_cycles of town must be a whole number above 0, not 0"),
        (Town, {"scripted": {"mayor": len}}, "town has no agent 'mayor' to script: it has guard_0"),
        (Town, {"scripted": dict.fromkeys(SEEN, len)}, "all agents of town are scripted"),
        (lambda: 3, {"name": "three"}, "three is no PettingZoo parallel environment: it has no `possible_agents`"),
        (lambda: 1 / 0, {}, "the environment cannot be made with {}: ZeroDivisionError: division by zero"),
        (Town(), {}, "from_pettingzoo needs a function that makes an environment, not Town"),
    ],
)
def test_an_environment_that_does_not_fit_is_one_sentence(
    make: Any, settings: Any, sentence: str, unchecked: None
):
    with pytest.raises(gacrl.ConfigError) as error:
        own.bring(gacrl.from_pettingzoo(make, **settings))
    assert sentence in str(error.value)


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        (
            "pettingzoo:mpe2.simple_spred_v3",
            "No module named 'mpe2.simple_spred_v3'; install it, or name a module",
        ),
        (
            "pettingzoo:sisl/pursuit_v4",
            "unknown parallel environment 'sisl/pursuit_v4': did you mean",
        ),
        ("pettingzoo:classic/chess_v6", "the environment is turn-based (AEC)"),
        ("pettingzoo:json", "it has no `parallel_env`"),
    ],
)
def test_a_module_without_an_environment_is_one_sentence(name: str, sentence: str):
    with pytest.raises(gacrl.ConfigError) as error:
        own.bring(name)
    assert str(error.value).startswith(f"--env {name}: ") and sentence in str(error.value)


def test_settings_are_the_environments_own_arguments():
    name, settings = own.bring("pettingzoo:mpe2.simple_spread_v3")
    assert (settings.N, settings.local_ratio, settings.max_cycles, settings.num_agent_neighbors) == (
        3,
        0.5,
        25,
        None,
    )
    assert not hasattr(settings, "render_mode")
    assert gacrl.tasks.flag(name) == " --env pettingzoo:mpe2.simple_spread_v3"
    changed = gacrl.make_env(name, N=4, max_cycles=7, num_agent_neighbors=1)
    assert (changed.num_agents, changed.max_cycles, changed.observation_size) == (4, 7, 2 + 2 + 2 * 4 + 2 + 2)
    with pytest.raises(gacrl.ConfigError, match=r"env.local_ratio must be a number, not 'low'|local_ratio"):
        gacrl.make_env(name, local_ratio="low")
