"""Pictures: everything is in them, where and in the colour that it should be, for any size of team."""

import itertools

import numpy as np
import pytest
from PIL import Image, ImageColor

from gacrl import render
from gacrl.evaluation.episodes import Episode

VISION = {
    "usual": np.eye(3),
    # Machado, Oliveira and Fernandes 2009, severity 1, on linear RGB.
    "protanopia": [[0.152, 1.053, -0.205], [0.115, 0.786, 0.099], [-0.004, -0.048, 1.052]],
    "deuteranopia": [[0.367, 0.861, -0.228], [0.280, 0.673, 0.047], [-0.012, 0.043, 0.969]],
    "tritanopia": [[1.256, -0.077, -0.179], [-0.078, 0.931, 0.148], [0.005, 0.691, 0.304]],
}


def world(positions, landmarks, steps=3, symbols=None, hears=None, **changes) -> Episode:
    """An episode in which nothing moves, unless there are rows for every step."""
    positions, landmarks = (np.asarray(rows, float) for rows in (positions, landmarks))
    positions, landmarks = (
        np.repeat(rows[None], steps + 1, axis=0) if rows.ndim == 2 else rows for rows in (positions, landmarks)
    )
    agents = positions.shape[1]
    messages = None if symbols is None else np.eye(64)[np.repeat([symbols], steps, axis=0)]
    values = {
        "positions": positions,
        "landmarks": landmarks,
        "actions": np.zeros((steps, agents), int),
        "reward": np.zeros((steps, agents)),
        "reward_raw": np.full(steps, -1.5),
        "agent_mask": np.ones(agents, bool),
        "landmark_mask": np.ones(landmarks.shape[1], bool),
        "agent_radius": 0.15,
        "capture_radius": 0.1,
        "arena_scale": 1.0,
        "messages": messages,
        "adjacency": None if hears is None else np.repeat(np.asarray(hears, bool)[None], steps, axis=0),
    }
    return Episode(**(values | changes))


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
        messages=rng.uniform(size=(steps, agents, 8)),
        adjacency=(distance < 1.5) & ~np.eye(agents, dtype=bool),
    )


def test_the_gif_has_every_frame_for_its_time_and_shows_what_frame_shows(tmp_path):
    episodes = [world([[0, 0]], [[0.5, 0.5]], steps=3, symbols=[1]), walk(0, steps=5)]
    path = tmp_path / "two.gif"
    render.gif(episodes, path, size=240, fps=20, title="Two")
    assert [file.name for file in tmp_path.iterdir()] == ["two.gif"]
    with Image.open(path) as film:
        assert film.n_frames == 4 + 6
        assert film.info["loop"] == 0
        shown = [(episode, t) for episode in episodes for t in range(episode.num_steps + 1)]
        durations = []
        for k, (episode, t) in enumerate(shown):
            film.seek(k)
            durations.append(film.info["duration"])
            expected = render.frame(episode, t, 240, "Two")
            assert film.size == expected.size
            seen = np.asarray(film.convert("RGB"))[20:].astype(int)  # "episode 1 of 2" stands above
            error = np.abs(seen - np.asarray(expected)[20:]).max(-1)
            assert (error > 0).mean() < 0.15
            assert error.max() < 90
    assert durations == [600, 50, 50, 1500, 600, 50, 50, 50, 50, 1500]


def test_four_usual_episodes_make_a_small_file(tmp_path):
    path = tmp_path / "four.gif"
    render.gif([walk(seed) for seed in range(4)], path)
    assert 100_000 < path.stat().st_size < 800_000


def test_a_covered_landmark_has_the_covered_colour_and_only_that_one():
    picture = render.frame(world([[-0.65, 0.3], [0, -0.8]], [[-0.6, 0.3], [0.6, -0.3]]), 0)
    values = scene(picture)
    scale = 480 * 0.92 / 2  # the view is the start square and a margin
    covered, dashes = where(values, render.COVERED), where(values, render.UNCOVERED)
    np.testing.assert_allclose(covered.mean(0), 240 - np.array([0.3, 0.6]) * scale, atol=3)
    np.testing.assert_allclose(np.ptp(covered, axis=0), 0.2 * scale, atol=3)
    dashes = dashes[(dashes[:, 1] > 300) & (dashes[:, 0] < 400)]  # apart from what is written
    np.testing.assert_allclose(dashes.mean(0), 240 + np.array([0.3, 0.6]) * scale, atol=3)
    np.testing.assert_allclose(np.ptp(dashes, axis=0), 0.2 * scale, atol=4)


def test_each_agent_shows_its_symbol_in_a_colour_of_its_own():
    columns = np.linspace(-0.85, 0.85, 4)
    places = [(x, y) for y in (0.5, -0.5) for x in columns]
    values = scene(render.frame(world(places, [[0, 0]], symbols=range(8)), 0))
    for (x, y), colour in zip(places, render.SYMBOL_COLOURS, strict=True):
        row, column = where(values, colour, 4).mean(0)
        assert abs(column - 240 - 220 * (x + 0.15)) < 12
        assert abs(row - (240 - 220 * (y + 0.15))) < 12
    # After the last step the last words stay; the ninth symbol has the first one's colour, not its letter.
    quiet = world([[0, 0]], [[0.5, 0.5]], messages=np.zeros((3, 1, 8)))
    first, ninth = (scene(render.frame(world([[0, 0]], [[0.5, 0.5]], symbols=[s]), 3)) for s in (0, 8))
    assert len(where(first, render.SYMBOL_COLOURS[0])) > 100
    assert len(where(scene(render.frame(quiet, 3)), render.SYMBOL_COLOURS[0])) == 0
    assert 5 < (first != ninth).any(-1).sum() < 200


@pytest.mark.parametrize("vision", VISION)
def test_colours_can_be_told_apart(vision):
    def lab(colour: str) -> np.ndarray:
        rgb = np.array(ImageColor.getrgb(colour)) / 255
        linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
        seen = np.clip(VISION[vision] @ linear, 0, 1)
        to_xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
        xyz = to_xyz @ seen / to_xyz.sum(1)
        x, y, z = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16 / 116)
        return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])

    colours = [*render.SYMBOL_COLOURS, render.COVERED]
    assert min(np.linalg.norm(lab(a) - lab(b)) for a, b in itertools.combinations(colours, 2)) > 20


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
    masks = {"agent_mask": np.array([True, False]), "landmark_mask": np.array([False, True])}
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


def test_what_cannot_be_drawn_or_written(tmp_path):
    episode = world([[0, 0]], [[0.5, 0.5]])
    with pytest.raises(OSError):
        render.gif([episode], tmp_path / "no folder" / "film.gif")
    (tmp_path / "folder.gif").mkdir()
    with pytest.raises(OSError):
        render.gif([episode], tmp_path / "folder.gif", size=120)
    assert [file.name for file in tmp_path.iterdir()] == ["folder.gif"]
    for wrong in ({"size": 10}, {"fps": 0}, {"fps": 1000}):
        with pytest.raises(ValueError, match="must be"):
            render.gif([episode], tmp_path / "film.gif", **wrong)
    with pytest.raises(ValueError, match="at least one episode"):
        render.gif([], tmp_path / "film.gif")
    with pytest.raises(ValueError, match="the frames 0 to 3, not 4"):
        render.frame(episode, 4)
    assert render.frame(episode, 0, 120, "long\n" * 99).size[0] == 120
