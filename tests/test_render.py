"""Pictures: everything is in them, where and in the colour that it should be, for any size of team."""

import itertools
import weakref
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from PIL import Image, ImageColor

from gacrl import pen, reel, render
from gacrl.evaluation.episodes import Episode
from gacrl.scene import PLAIN, Discs, Scene
from gacrl.tasks.task import Words

SPREAD = Words(mark="landmark", lit="covered")

VISION = {
    "usual": np.eye(3),
    # Machado, Oliveira and Fernandes 2009, severity 1, on linear RGB.
    "protanopia": [[0.152, 1.053, -0.205], [0.115, 0.786, 0.099], [-0.004, -0.048, 1.052]],
    "deuteranopia": [[0.367, 0.861, -0.228], [0.280, 0.673, 0.047], [-0.012, 0.043, 0.969]],
    "tritanopia": [[1.256, -0.077, -0.179], [-0.078, 0.931, 0.148], [0.005, 0.691, 0.304]],
}


def discs(positions: np.ndarray, radius: float, there: Any, lit: Any = False) -> Discs:
    """Things of one radius that are there, and lit, for all the time or as rows of moments say."""
    shape = positions.shape[:2]
    return Discs(
        positions=positions,
        radius=np.full(shape, radius),
        there=np.broadcast_to(there, shape),
        lit=np.broadcast_to(lit, shape),
        colour=np.full(shape, PLAIN),
    )


def world(
    positions,
    landmarks,
    steps=3,
    symbols=None,
    hears=None,
    agent_mask=True,
    landmark_mask=True,
    **changes,
) -> Episode:
    """An episode of spread in which nothing moves, unless there are rows for every step."""
    positions, landmarks = (np.asarray(rows, float) for rows in (positions, landmarks))
    positions, landmarks = (
        np.repeat(rows[None], steps + 1, axis=0) if rows.ndim == 2 else rows for rows in (positions, landmarks)
    )
    agents = positions.shape[1]
    messages = None if symbols is None else np.eye(64)[np.repeat([[symbols]], steps, axis=0)]
    seen = discs(positions, 0.15, agent_mask)
    near = np.linalg.norm(positions[:, :, None] - landmarks[:, None], axis=-1) < 0.1
    values = {
        "scene": Scene(
            agents=seen,
            marks=discs(landmarks, 0.1, landmark_mask, (near & seen.there[..., None]).any(1)),
            lines=np.zeros((steps + 1, 0, 2, 2)),
            ground=np.tile([[-1.0, -1.0], [1.0, 1.0]], (steps + 1, 1, 1)),
        ),
        "actions": np.zeros((steps, agents), int),
        "reward": np.zeros((steps, agents)),
        "reward_raw": np.full(steps, -1.5),
        "agent_mask": seen.there[:-1],
        "messages": messages,
        "adjacency": None if hears is None else np.repeat(np.asarray(hears, bool)[None], steps, axis=0),
    }
    return Episode(**(values | changes))


def scene_of(episode: Episode) -> Scene:
    assert episode.scene is not None
    return episode.scene


def redrawn(episode: Episode, agents: dict[str, Any] | None = None, **changes: Any) -> Episode:
    """The same episode with another look: of its agents, its marks or the rest of its scene."""
    look = scene_of(episode)
    marks = look.marks._replace(**changes.pop("marks", {}))
    return replace(
        episode, scene=look._replace(agents=look.agents._replace(**agents or {}), marks=marks, **changes)
    )


def scene(picture: Image.Image) -> np.ndarray:
    """The square between title and footer, as [width, width, 3]."""
    top = picture.height - picture.width - round(picture.width * 92 / 480)
    return np.asarray(picture).astype(int)[top : top + picture.width]


def where(values: np.ndarray, colour: str, tolerance: float = 12) -> np.ndarray:
    """Rows and columns of the pixels of a colour, as [K, 2]."""
    return np.argwhere(np.linalg.norm(values - ImageColor.getrgb(colour), axis=-1) <= tolerance)


def walk(seed: int, agents: int = 3, steps: int = 25) -> Episode:
    rng = np.random.default_rng(seed)
    moves = rng.normal(0, 0.08, (steps + 1, agents, 2)).cumsum(0)
    positions = rng.uniform(-1, 1, (agents, 2)) + moves
    distance = np.linalg.norm(positions[:-1, :, None] - positions[:-1, None], axis=-1)
    return world(
        positions,
        rng.uniform(-1, 1, (agents, 2)),
        steps,
        messages=rng.dirichlet(np.ones(8), (steps, 1, agents)),
        adjacency=(distance < 1.5) & ~np.eye(agents, dtype=bool),
    )


def test_the_gif_has_every_frame_for_its_time_and_shows_what_frame_shows(tmp_path):
    episodes = [world([[0, 0]], [[0.5, 0.5]], steps=3, symbols=[1]), walk(0, steps=5)]
    path = tmp_path / "two.gif"
    reel.gif(episodes, path, size=240, fps=20, title="Two", words=SPREAD)
    assert [file.name for file in tmp_path.iterdir()] == ["two.gif"]
    with Image.open(path) as film:
        assert film.n_frames == 4 + 6
        assert film.info["loop"] == 0
        shown = [(episode, t) for episode in episodes for t in range(episode.num_steps + 1)]
        durations = []
        for k, (episode, t) in enumerate(shown):
            film.seek(k)
            durations.append(film.info["duration"])
            expected = render.frame(episode, t, 240, "Two", SPREAD)
            assert film.size == expected.size
            seen = np.asarray(film.convert("RGB"))[20:].astype(int)  # "episode 1 of 2" stands above
            error = np.abs(seen - np.asarray(expected)[20:]).max(-1)
            assert (error > 0).mean() < 0.15
            assert error.max() < 90
    assert durations == [600, 50, 50, 1500, 600, 50, 50, 50, 50, 1500]


def test_a_long_episode_is_thinned_and_no_more_than_a_frame_is_kept(tmp_path, monkeypatch):
    """41 moments in 9 frames, five apart; and 3 in 3. Each is on the disk before the next is drawn."""
    monkeypatch.setattr(reel, "MOST_FRAMES", 9)
    kept, written, add = [], [], reel._Film.add

    def watched(film, frame, pause) -> None:
        kept.append(weakref.ref(frame))
        add(film, frame, pause)
        assert sum(frame() is not None for frame in kept) <= 2, "this one and the one before"
        written.append(film._file.tell())

    monkeypatch.setattr(reel._Film, "add", watched)
    long, path = walk(0, steps=40), tmp_path / "long.gif"
    reel.gif([long, walk(1, steps=2)], path, size=240, fps=20, title="Long", words=SPREAD)
    assert len(written) == 12 and (np.diff(written) > 0).all()
    assert (reel.num_frames(40), reel.num_frames(2)) == (9, 3)
    with Image.open(path) as film:
        assert film.n_frames == 12
        durations = []
        for k in range(12):
            film.seek(k)
            durations.append(film.info["duration"])
            if k < 9:
                expected = np.asarray(render.frame(long, 5 * k, 240, "Long", SPREAD))[20:]
                error = np.abs(np.asarray(film.convert("RGB"))[20:].astype(int) - expected).max(-1)
                assert (error > 0).mean() < 0.15 and error.max() < 90
    assert durations == [600, *[50] * 7, 1500, 600, 50, 1500]


def test_a_frame_in_which_nothing_changes_has_its_time(tmp_path):
    path, still = tmp_path / "still.gif", np.zeros((4, 5), np.uint8)
    with path.open("wb") as file:
        film = reel._Film(file, [10, 20, 30, 200, 100, 50])
        for pause in (600, 50, 1500):
            film.add(still, pause)
        film.end()
    with Image.open(path) as film:
        assert film.n_frames == 3
        for k, pause in enumerate((600, 50, 1500)):
            film.seek(k)
            assert film.info["duration"] == pause
            assert (np.asarray(film.convert("RGB")) == [10, 20, 30]).all()


def test_four_usual_episodes_make_a_small_file(tmp_path):
    path = tmp_path / "four.gif"
    reel.gif([walk(seed) for seed in range(4)], path, words=SPREAD)
    assert 100_000 < path.stat().st_size < 800_000


def test_a_covered_landmark_has_the_covered_colour_and_only_that_one():
    picture = render.frame(world([[-0.65, 0.3], [0, -0.8]], [[-0.6, 0.3], [0.6, -0.3]]), 0)
    values = scene(picture)
    scale = 480 * 0.92 / 2  # the view is the start square and a margin
    covered, dashes = where(values, pen.COVERED), where(values, pen.UNCOVERED)
    np.testing.assert_allclose(covered.mean(0), 240 - np.array([0.3, 0.6]) * scale, atol=3)
    np.testing.assert_allclose(np.ptp(covered, axis=0), 0.2 * scale, atol=3)
    dashes = dashes[(dashes[:, 1] > 300) & (dashes[:, 0] < 400)]  # apart from what is written
    np.testing.assert_allclose(dashes.mean(0), 240 + np.array([0.3, 0.6]) * scale, atol=3)
    np.testing.assert_allclose(np.ptp(dashes, axis=0), 0.2 * scale, atol=4)


def test_each_agent_shows_its_symbol_in_a_colour_of_its_own():
    columns = np.linspace(-0.85, 0.85, 4)
    places = [(x, y) for y in (0.5, -0.5) for x in columns]
    values = scene(render.frame(world(places, [[0, 0]], symbols=range(8)), 0))
    for (x, y), colour in zip(places, pen.SYMBOL_COLOURS, strict=True):
        row, column = where(values, colour, 4).mean(0)
        assert abs(column - 240 - 220 * (x + 0.15)) < 12
        assert abs(row - (240 - 220 * (y + 0.15))) < 12
    # After the last step the last words stay; the ninth symbol has the first one's colour, not its letter.
    quiet = world([[0, 0]], [[0.5, 0.5]], messages=np.zeros((3, 1, 1, 8)))
    first, ninth = (scene(render.frame(world([[0, 0]], [[0.5, 0.5]], symbols=[s]), 3)) for s in (0, 8))
    assert len(where(first, pen.SYMBOL_COLOURS[0])) > 100
    assert len(where(scene(render.frame(quiet, 3)), pen.SYMBOL_COLOURS[0])) == 0
    assert 5 < (first != ninth).any(-1).sum() < 200


def test_each_round_has_a_bubble_of_its_own_from_left_to_right():
    def said(*rounds: Any) -> np.ndarray:
        """One agent's words of each round, at each of three steps."""
        words = np.stack([np.eye(8)[word] if isinstance(word, int) else np.asarray(word) for word in rounds])
        return np.tile(words[None, :, None], (3, 1, 1, 1))

    def picture(messages: np.ndarray | None) -> np.ndarray:
        return np.asarray(render.frame(world([[0, 0]], [[0.9, 0.9]], messages=messages), 1)).astype(int)

    def columns(values: np.ndarray, symbol: int) -> np.ndarray:
        return where(values[38:518], pen.SYMBOL_COLOURS[symbol], 4)[:, 1]

    both, first = picture(said(1, 2)), picture(said(1))
    np.testing.assert_allclose(columns(both, 1).mean(), columns(first, 1).mean(), atol=3)
    assert len(columns(first, 2)) == 0 and len(columns(both, 2)) > 100
    assert columns(both, 2).mean() - columns(both, 1).mean() > 8
    three = picture(said(1, 2, 3))
    steps = np.diff([columns(three, symbol).mean() for symbol in (1, 2, 3)])
    np.testing.assert_allclose(steps[0], steps[1], atol=4)
    # Words that are no symbol, and no word, have no bubble; nor a line in the legend where there is no other.
    numbers = np.linspace(-1, 2, 8)
    np.testing.assert_array_equal(picture(said(numbers, 1)), first)
    np.testing.assert_array_equal(picture(said(np.zeros(8), 1)), first)
    np.testing.assert_array_equal(picture(said(numbers, numbers)), picture(None))
    assert (picture(None)[-40:] != first[-40:]).any()


def seen_as(colour: str, vision: str) -> np.ndarray:
    """CIE Lab of a colour as somebody sees it."""
    rgb = np.array(ImageColor.getrgb(colour)) / 255
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    seen = np.clip(VISION[vision] @ linear, 0, 1)
    to_xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    xyz = to_xyz @ seen / to_xyz.sum(1)
    x, y, z = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16 / 116)
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


@pytest.mark.parametrize("vision", VISION)
def test_colours_can_be_told_apart(vision):
    colours = [*pen.SYMBOL_COLOURS, pen.COVERED]
    assert (
        min(np.linalg.norm(seen_as(a, vision) - seen_as(b, vision)) for a, b in itertools.combinations(colours, 2))
        > 20
    )


@pytest.mark.parametrize("agents", [1, 30])
@pytest.mark.parametrize("speaks", [True, False])
def test_any_team_is_wholly_in_the_picture_however_far_it_runs(agents, speaks):
    rng = np.random.default_rng(agents)
    start, end = rng.uniform(-1, 1, (agents, 2)), rng.uniform(2, 9, (agents, 2)) * [1, -1]
    symbols = rng.integers(0, 8, agents) if speaks else None
    hears = ~np.eye(agents, dtype=bool) if speaks else None
    episode = world(np.stack([start, end]), np.stack([start[:2], start[:2]]), 1, symbols, hears)
    for t in (0, 1):
        picture = render.frame(episode, t, size=300)
        values = np.asarray(picture).astype(int)
        assert len(where(scene(picture), "#3f566e", 40)) > 5 * agents  # the rims of the discs
        for strip in (values[:, :4], values[:, -4:]):
            assert (strip == strip[:, :1]).all()


def test_who_hears_whom_is_a_line_and_an_arrow_where_only_one_does():
    def middle_of_the_picture(hears) -> np.ndarray:
        values = scene(render.frame(world([[-0.8, 0], [0.8, 0]], [[0, 0.9]], hears=hears), 0))
        return values[220:260]

    nobody = middle_of_the_picture([[0, 0], [0, 0]])
    both = middle_of_the_picture([[0, 1], [1, 0]])
    left, right = middle_of_the_picture([[0, 1], [0, 0]]), middle_of_the_picture([[0, 0], [1, 0]])
    assert (nobody != both).any(-1).sum() > 200
    for arrow, tip in ((left, 240 - 0.65 * 220), (right, 240 + 0.65 * 220)):
        difference = np.argwhere(np.abs(arrow - both).max(-1) > 60)
        assert np.abs(difference[:, 1] - tip).max() < 14


def test_padding_is_not_drawn_and_a_new_placement_leaves_no_trail():
    masks: dict[str, Any] = {"agent_mask": [True, False], "landmark_mask": [False, True]}
    padded = world([[0.5, 0.5], [0, 0]], [[0, 0], [-0.5, 0]], **masks)
    alone = world([[0.5, 0.5]], [[-0.5, 0]])
    np.testing.assert_array_equal(scene(render.frame(padded, 2)), scene(render.frame(alone, 2)))

    def strip_of_the_way(*path) -> np.ndarray:
        positions = np.array(path)[:, None, :]
        return scene(render.frame(world(positions, [[0, 0.9]], len(path) - 1), len(path) - 1))[238:242]

    def change(path) -> int:
        return (strip_of_the_way(*path) != strip_of_the_way(path[-1], path[-1])).any(-1).sum()

    assert change([(-0.8, 0), (0.8, 0)]) == 0
    assert change([(-0.8, 0), (-0.4, 0), (0, 0), (0.4, 0), (0.8, 0)]) > 400


def test_who_is_not_there_yet_is_not_drawn_and_leaves_no_trail():
    """The second agent joins at the third moment of five: until then the picture is that of the first alone."""
    path = np.stack([np.linspace(-0.8, 0.8, 5), np.zeros(5)], axis=1)
    positions = np.stack([np.tile([0.0, -0.8], (5, 1)), path], axis=1)
    joins = [[True, False]] * 2 + [[True, True]] * 3
    joining, there = (world(positions, [[0, 0.9]], 4, agent_mask=mask) for mask in (joins, True))
    alone = world(positions[:, :1], [[0, 0.9]], 4)
    for t in (0, 1):
        np.testing.assert_array_equal(scene(render.frame(joining, t)), scene(render.frame(alone, t)))
        assert (scene(render.frame(there, t)) != scene(render.frame(alone, t))).any()
    # At its first moment there is the agent and no way that it came; later the way from there on.
    still = world(np.stack([positions[:, 0], np.tile(path[2], (5, 1))], axis=1), [[0, 0.9]], 4)
    np.testing.assert_array_equal(scene(render.frame(joining, 2)), scene(render.frame(still, 2)))
    last, whole = (scene(render.frame(episode, 4))[238:242] for episode in (joining, there))
    columns = np.flatnonzero((last != whole).any((0, 2)))
    assert columns.min() > 240 - 0.8 * 221 - 3 and columns.max() < 240 + 3, "the first half of the way is missing"
    assert len(columns) > 100


def test_who_has_left_is_not_drawn_and_says_nothing():
    """Of two speakers the second leaves with the last step; its words do not stay behind."""
    places = [[-0.5, 0.0], [0.5, 0.0]]
    leaving = world(places, [[0, 0.9]], 3, [1, 2], agent_mask=[[True, True]] * 3 + [[True, False]])
    staying = world(places, [[0, 0.9]], 3, [1, 2])
    for t in range(3):
        np.testing.assert_array_equal(scene(render.frame(leaving, t)), scene(render.frame(staying, t)))
    assert len(where(scene(render.frame(leaving, 3)), pen.SYMBOL_COLOURS[1])) > 100
    assert len(where(scene(render.frame(leaving, 3)), pen.SYMBOL_COLOURS[2])) == 0
    assert len(where(scene(render.frame(staying, 3)), pen.SYMBOL_COLOURS[2])) > 100
    alone = world(places[:1], [[0, 0.9]], 3, [1])
    np.testing.assert_array_equal(scene(render.frame(leaving, 3)), scene(render.frame(alone, 3)))


def test_no_line_leads_to_who_has_left():
    """The graph of the last step stays with the last words, but for those who are no longer there."""
    places, both = [[-0.5, 0.0], [0.5, 0.0]], [[0, 1], [1, 0]]
    leaving = world(places, [[0, 0.9]], hears=both, agent_mask=[[True, True]] * 3 + [[True, False]])
    staying = world(places, [[0, 0.9]], hears=both)
    np.testing.assert_array_equal(scene(render.frame(leaving, 2)), scene(render.frame(staying, 2)))
    np.testing.assert_array_equal(
        scene(render.frame(leaving, 3)), scene(render.frame(world(places[:1], [[0, 0.9]]), 3))
    )


def test_marks_are_counted_where_they_are_there_and_lit():
    """What the footer says changes with what is lit, and not with what is not there."""
    marks, agents = [[0.9, 0.9], [0.9, -0.9], [-0.9, 0.9]], [[0.0, 0.0]]

    def footer(lit: list[bool], there: list[bool]) -> np.ndarray:
        episode = redrawn(
            world(agents, marks), marks={"lit": np.tile(lit, (4, 1)), "there": np.tile(there, (4, 1))}
        )
        return np.asarray(render.frame(episode, 1))[-92:-40]

    two_of_three = footer([True, True, False], [True] * 3)
    assert (two_of_three != footer([True, False, False], [True] * 3)).any()
    np.testing.assert_array_equal(two_of_three, footer([False, True, True], [True] * 3))
    one_of_two = footer([True, False, True], [True, True, False])
    np.testing.assert_array_equal(one_of_two, footer([True, False, True], [False, True, True]))
    assert (one_of_two != two_of_three).any()


def test_agents_with_goals_are_counted_where_they_are_at_their_own():
    """Two of one goal are two; another's mark is no goal; who has no colour seeks nothing."""

    def counted(places: list[list[float]], colours: list[int]) -> tuple[str, str]:
        episode = redrawn(
            world(places, [[0.5, 0.5], [-0.5, -0.5]]),
            agents={"colour": np.tile(colours, (4, 1))},
            marks={"colour": np.tile([0, 1], (4, 1))},
        )
        picture = render.Picture(episode, 480)
        return picture._counted, picture._counts[1]

    at, beside = [0.5, 0.5], [-0.5, -0.5]
    assert counted([at, at], [0, 0]) == ("agents at their place", "2 / 2")
    assert counted([at, beside], [0, 0]) == ("agents at their place", "1 / 2")
    assert counted([beside, at], [0, PLAIN]) == ("agents at their place", "0 / 1")
    assert counted([at, at], [PLAIN, PLAIN])[0] == "places reached"


def test_things_are_called_what_the_task_calls_them():
    """In title, captions and legend, and nowhere else; an agent and a mark of their own name."""
    episode = world([[0, 0], [0.5, 0.5]], [[0.5, -0.5]])
    usual, spread = (np.asarray(render.frame(episode, 1, words=words)) for words in (Words(), SPREAD))
    np.testing.assert_array_equal(usual[38:518], spread[38:518])
    assert (usual[:38] != spread[:38]).any() and (usual[518:] != spread[518:]).any()
    cars = np.asarray(render.frame(episode, 1, words=replace_words(agent="car")))
    assert (usual[:38] != cars[:38]).any() and (usual[-40:] != cars[-40:]).any()
    np.testing.assert_array_equal(usual[518:570], cars[518:570])
    named = np.asarray(render.frame(episode, 1, title="Two of them", words=replace_words(agent="car")))
    np.testing.assert_array_equal(named[:38], np.asarray(render.frame(episode, 1, title="Two of them"))[:38])


def replace_words(**words: str) -> Words:
    return Words()._replace(**words)


def test_without_marks_nothing_is_said_of_them():
    """Neither in the title, nor in the footer, nor in the legend: whatever they would be called."""
    bare = world([[0, 0]], np.zeros((4, 0, 2)))
    first, second = (np.asarray(render.frame(bare, 1, words=words)) for words in (Words(), SPREAD))
    np.testing.assert_array_equal(first, second)
    hidden = world([[0, 0]], [[0.5, 0.5]], landmark_mask=False)
    np.testing.assert_array_equal(np.asarray(render.frame(hidden, 1)), first)


def test_colours_of_agents_and_marks_are_those_of_the_symbols():
    """A rim, or a cross in a ring; the ninth begins again, and what has no colour has none of them."""
    plain = world([[-0.5, 0.0]], [[0.5, 0.0]])
    colour = pen.SYMBOL_COLOURS[2]
    assert len(where(scene(render.frame(plain, 1)), colour)) == 0
    agent = redrawn(plain, agents={"colour": np.full((4, 1), 2)})
    found = where(scene(render.frame(agent, 1)), colour)
    assert len(found) > 100 and (found[:, 1] < 240).all()
    np.testing.assert_allclose(np.ptp(found, axis=0), 2 * 0.15 * 220.8, atol=4)
    mark = redrawn(plain, marks={"colour": np.full((4, 1), 2)})
    found = where(scene(render.frame(mark, 1)), colour)
    assert len(found) > 60 and (found[:, 1] > 240).all()
    np.testing.assert_allclose(np.ptp(found, axis=0), 2 * 0.1 * 220.8, atol=6)
    again = redrawn(plain, agents={"colour": np.full((4, 1), 10)})
    np.testing.assert_array_equal(scene(render.frame(again, 1)), scene(render.frame(agent, 1)))
    # A lit mark of a colour shows both.
    lit = redrawn(mark, marks={"lit": np.ones((4, 1), bool)})
    values = scene(render.frame(lit, 1))
    assert len(where(values, colour, 40)) > 40 and len(where(values, pen.COVERED)) > 40


def test_an_agent_that_is_lit_has_a_rim_of_alarm():
    plain = world([[-0.5, 0.0], [0.5, 0.0]], [[0.0, 0.9]])
    alarm = redrawn(plain, agents={"lit": np.array([[False, False]] * 2 + [[False, True]] * 2)})
    for t in (0, 1):
        np.testing.assert_array_equal(scene(render.frame(alarm, t)), scene(render.frame(plain, t)))
    for t in (2, 3):
        found = where(scene(render.frame(alarm, t)), "#c0392b")
        assert len(found) > 100 and (found[:, 1] > 240).all()


def test_roads_lie_where_they_are_said_to_and_are_wholly_in_the_picture():
    lines = np.tile([[[-0.5, 0.5], [0.5, 0.5]]], (4, 1, 1, 1)).astype(float)
    plain = world([[0.0, -0.5]], [[0.0, -0.9]])
    road = redrawn(plain, lines=lines)
    found = np.argwhere((scene(render.frame(road, 1)) != scene(render.frame(plain, 1))).any(-1))
    np.testing.assert_allclose(found[:, 0].mean(), 240 - 0.5 * 220.8, atol=2)
    np.testing.assert_allclose(found[:, 1].min(), 240 - 0.5 * 220.8, atol=3)
    np.testing.assert_allclose(found[:, 1].max(), 240 + 0.5 * 220.8, atol=3)
    far = redrawn(plain, lines=lines * [8.0, 1.0])
    values = scene(render.frame(far, 1))
    road_rows = np.flatnonzero((values == ImageColor.getrgb("#d5dae0")).all(-1).sum(1) > 300)
    assert len(road_rows) > 0
    columns = np.flatnonzero((values[road_rows[0]] == ImageColor.getrgb("#d5dae0")).all(-1))
    assert 4 < columns.min() < 40 and 440 < columns.max() < 476


def test_without_a_ground_the_picture_is_of_what_there_is():
    """Everything is start area then: the picture holds the agents and marks, however small they are."""
    far = world([[100.0, 100.0], [101.0, 100.0]], [[100.5, 100.5]])
    bare = redrawn(far, ground=np.zeros((4, 2, 2)))
    picture = scene(render.frame(bare, 1))
    assert (picture[:3] == 255).all() and (picture[:, :3] == 255).all()
    rims = where(picture, "#3f566e", 40)
    assert np.ptp(rims[:, 1]) > 400, "from one disc's edge to the other's"
    ground = scene(render.frame(far, 1))  # a square of 2 far away, and all in between
    assert np.ptp(where(ground, "#3f566e", 60)[:, 1]) < 40


def test_what_cannot_be_drawn_or_written(tmp_path):
    episode = world([[0, 0]], [[0.5, 0.5]])
    with pytest.raises(OSError):
        reel.gif([episode], tmp_path / "no folder" / "film.gif")
    (tmp_path / "folder.gif").mkdir()
    with pytest.raises(OSError):
        reel.gif([episode], tmp_path / "folder.gif", size=120)
    assert [file.name for file in tmp_path.iterdir()] == ["folder.gif"]
    for wrong in ({"size": 10}, {"fps": 0}, {"fps": 1000}):
        with pytest.raises(ValueError, match="must be"):
            reel.gif([episode], tmp_path / "film.gif", **wrong)
    with pytest.raises(ValueError, match="at least one episode"):
        reel.gif([], tmp_path / "film.gif")
    with pytest.raises(ValueError, match="the frames 0 to 3, not 4"):
        render.frame(episode, 4)
    unseen = replace(episode, scene=None)
    with pytest.raises(ValueError, match="the episode has no scene: there is nothing to draw"):
        render.frame(unseen, 0)
    with pytest.raises(ValueError, match="the episode has no scene"):
        reel.gif([episode, unseen], tmp_path / "film.gif")
    assert [file.name for file in tmp_path.iterdir()] == ["folder.gif"]
    assert render.frame(episode, 0, 120, "long\n" * 99).size[0] == 120
