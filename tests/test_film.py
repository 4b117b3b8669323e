"""Episodes as files to watch: every frame reaches ffmpeg, as often as it is seen; what cannot be is a sentence."""

import os
import stat
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from test_render import world

from gacrl import film, reel, render
from gacrl.cli.main import main
from gacrl.errors import UserError

FFMPEG = """import json, sys
words = sys.argv[1:]
if {fails}:
    print("Unknown encoder", file=sys.stderr)
    sys.exit(1)
data = sys.stdin.buffer.read()
with open(words[-1].removeprefix("file:"), "wb") as file:
    file.write(json.dumps(words).encode() + b"\\n" + data)
"""


@pytest.fixture
def ffmpeg(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A program of that name that keeps what it is given; or fails."""

    def make(fails: bool = False) -> None:
        path = tmp_path / "bin" / "ffmpeg"
        path.parent.mkdir(exist_ok=True)
        path.with_suffix(".py").write_text(FFMPEG.format(fails=fails))
        path.write_text(f'#!/bin/sh\nexec "{sys.executable}" "$0.py" "$@"\n')
        path.chmod(path.stat().st_mode | stat.S_IEXEC)
        monkeypatch.setenv("PATH", str(path.parent), prepend=os.pathsep)

    return make


@pytest.fixture
def nobodys(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A machine without ffmpeg."""
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)


def test_an_mp4_has_every_frame_as_long_as_it_is_seen(ffmpeg, tmp_path: Path):
    ffmpeg()
    episodes = [world([[0, 0], [0.5, 0.5]], [[0.2, 0]], steps=steps) for steps in (3, 2)]
    out = tmp_path / "a: film.mp4"
    film.write(episodes, out, size=120)
    words, _, data = out.read_bytes().partition(b"\n")
    first = render.frame(episodes[0], 0, 120)
    assert f'"{first.width}x{first.height}"'.encode() in words
    frames = np.frombuffer(data, np.uint8).reshape(-1, first.height, first.width, 3)
    assert len(frames) == sum((6 + steps - 1 + 15) for steps in (3, 2)), "0.6 s first, 1.5 s last, at ten a second"
    drawn = [np.asarray(picture) for picture in reel.drawn(episodes, 120)]
    shown = np.repeat(np.arange(7), [6, 1, 1, 15, 6, 1, 15])
    for frame, number in zip(frames, shown, strict=True):
        np.testing.assert_array_equal(frame, drawn[number])
    assert sorted(path.name for path in tmp_path.iterdir()) == [out.name, "bin"]


def test_what_ffmpeg_cannot_is_told_in_its_words(ffmpeg, tmp_path: Path):
    ffmpeg(fails=True)
    with pytest.raises(UserError, match=r"ffmpeg could not write .*film.mp4: Unknown encoder$"):
        film.write([world([[0, 0]], [[0.2, 0]], steps=60)], tmp_path / "film.mp4", size=480)
    assert [path.name for path in tmp_path.iterdir()] == ["bin"], "nothing is left"


def test_without_ffmpeg_an_mp4_is_refused_and_no_gif_in_its_place(nobodys, tmp_path: Path):
    with pytest.raises(
        UserError, match=r"film.mp4: MP4 needs ffmpeg, and there is none on the PATH: install it, or"
    ):
        film.write([world([[0, 0]], [[0.2, 0]])], tmp_path / "film.mp4")
    assert list(tmp_path.iterdir()) == []


def test_a_gif_needs_nobody(nobodys, tmp_path: Path):
    film.write([world([[0, 0]], [[0.2, 0]])], tmp_path / "film.GIF", size=120)
    with Image.open(tmp_path / "film.GIF") as picture:
        assert picture.format == "GIF"


def test_a_strip_shows_moments_in_rows_and_what_is_beside_below(tmp_path: Path):
    played = [world([[0, 0]], [[0.2, 0]], steps=4), world([[0, 0]], [[0.2, 0]], steps=2)]
    others = [world([[0.5, 0]], [[0.2, 0]], steps=2), world([[3, 0]], [[0.2, 0]], steps=2)]
    beside = reel.Beside(others, "silent")
    out = tmp_path / "strip.png"
    film.write(played, out, size=120, title="as it is", beside=beside)
    first = render.frame(played[0], 0, 120)
    with Image.open(out) as strip:
        assert strip.size == (5 * first.width, 4 * first.height), "five moments of the longer one, four rows"
        picture = np.asarray(strip.convert("RGB"))
    assert (picture[2 * first.height :, 3 * first.width :] == 255).all(), "the other has three"
    films = list(reel.drawn(played, 120, "as it is", beside=beside))
    assert len(films) == len(reel.durations(played, 10, beside)) == 5 + 3
    wide = np.asarray(films[4])
    assert wide.shape[1] == 2 * first.width
    np.testing.assert_array_equal(wide[:, : first.width], picture[: first.height, -first.width :])
    np.testing.assert_array_equal(wide[:, first.width :], picture[first.height : 2 * first.height, -first.width :])
    with pytest.raises(UserError, match=r"a strip shows at most 6 episodes so, not 7; say --episodes 6"):
        film.write(played * 3 + played[:1], out, beside=reel.Beside(others * 3 + others[:1], ""))


def test_the_name_of_what_plays_stands_on_the_film(tmp_path: Path):
    """Read from the file: its title is drawn as the name of the run is, and not as another one."""
    out = tmp_path / "film.gif"
    assert main(["render", "noop", "--episodes", "1", "--horizon", "5", "--out", str(out)]) == 0
    with Image.open(out) as film:
        assert (film.format, film.n_frames) == ("GIF", 6)
        title = np.asarray(film.convert("L"))[:38]
    drawn = {
        name: np.asarray(render.frame(world([[0, 0]], [[0.5, 0.5]]), 0, title=name).convert("L"))[:38]
        for name in ("noop", "random")
    }
    off = {name: np.abs(title.astype(int) - other).mean() for name, other in drawn.items()}
    assert off["noop"] < 0.5 < 1 < off["random"]
