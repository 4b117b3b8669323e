"""Episodes as files to watch: every frame reaches ffmpeg, as often as it is seen; what cannot be is a sentence."""

import os
import stat
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from test_render import world

from gacrl import film, render
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
    drawn = [np.asarray(picture) for picture in render.drawn(episodes, 120)]
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
