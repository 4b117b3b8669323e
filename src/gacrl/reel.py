"""Episodes one after the other: an animated GIF, written frame by frame, or a strip of moments."""

import math
import struct
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import BinaryIO, NamedTuple, SupportsIndex

import numpy as np
from jaxtyping import UInt8
from PIL import GifImagePlugin, Image, ImageColor

from gacrl.config.checks import typed, whole
from gacrl.evaluation.episodes import Episode
from gacrl.pen import COVERED, INK, PAPER, SYMBOL_COLOURS, UNCOVERED
from gacrl.render import WORDS, Photos, Picture, laid_out
from gacrl.replacing import replaced
from gacrl.tasks.task import Words

_COLOURS = 96
"""Of a GIF's soft edges."""
_SAMPLES = 8
"""Frames that a GIF's palette is made from."""
_FIRST_SECONDS, _LAST_SECONDS = 0.6, 1.5
"""How long an episode's first and last frame stay."""
MOST_FRAMES = 200
"""Of an episode: of a longer one so many moments are shown, evenly spread."""

MOST_ROWS = 12
"""Of a strip."""


class Beside(NamedTuple):
    """Episodes from the same starts, one for each of those that they are shown beside."""

    episodes: Sequence[Episode]
    title: str


def gif(
    episodes: Sequence[Episode],
    path: Path,
    size: SupportsIndex = 480,
    fps: int | float = 10,
    title: str = "",
    words: Words = WORDS,
    beside: Beside | None = None,
) -> None:
    """Write the episodes, one after the other, as an animated GIF; each picture is `size` pixels wide.

    An episode of more than `MOST_FRAMES` moments is thinned to so many. One frame at a time is in memory. words: what
    the task calls the things in it. Raises OSError where the file cannot be written, ValueError without episodes, for
    one without a scene, or for an impossible size or speed.
    """
    pixels = whole(size, "size")
    pauses = durations(episodes, fps, beside)
    with replaced(path) as file:
        palette = _palette(drawn(episodes, pixels, title, words, -(-len(pauses) // _SAMPLES), beside))
        film = _Film(file, palette.getpalette() or [])
        for picture, pause in zip(drawn(episodes, pixels, title, words, 1, beside), pauses, strict=True):
            film.add(np.asarray(picture.quantize(palette=palette, dither=Image.Dither.NONE)), pause)
        film.end()


def strip(
    episodes: Sequence[Episode],
    path: Path,
    size: SupportsIndex = 480,
    title: str = "",
    words: Words = WORDS,
    beside: Beside | None = None,
    moments: int = 6,
) -> None:
    """Write so many moments of each episode, evenly spread, as one PNG: a row an episode, what is beside it below.

    Raises OSError where the file cannot be written, ValueError without episodes or for more than `MOST_ROWS` rows.
    """
    pixels, count = whole(size, "size"), len(episodes) * (1 if beside is None else 2)
    if not 1 <= count <= MOST_ROWS:
        raise ValueError(f"a strip has 1 to {MOST_ROWS} rows, not {count}: show fewer episodes")
    rows: list[np.ndarray] = []
    for pictures, last in _pictured(episodes, pixels, title, words, beside):
        times = [round(moment) for moment in np.linspace(0, last, min(moments, last + 1)).tolist()]
        rows += [np.hstack([np.asarray(picture.draw(t)) for t in times]) for picture in pictures]
    width = max(row.shape[1] for row in rows)
    white = [np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0)), constant_values=255) for row in rows]
    with replaced(path) as file:
        Image.fromarray(np.vstack(white)).save(file, "PNG")


def drawn(
    episodes: Sequence[Episode],
    size: int,
    title: str = "",
    words: Words = WORDS,
    step: int = 1,
    beside: Beside | None = None,
) -> Iterator[Image.Image]:
    """Draw every `step`-th frame of the episodes, one after the other."""
    number = 0
    for pictures, last in _pictured(episodes, size, title, words, beside):
        for t in _moments(last):
            if number % step == 0:
                frames = [picture.draw(t) for picture in pictures]
                yield frames[0] if len(frames) == 1 else Image.fromarray(np.hstack(list(map(np.asarray, frames))))
            number += 1


def _pictured(
    episodes: Sequence[Episode], size: int, title: str, words: Words, beside: Beside | None
) -> Iterator[tuple[list["Picture | Photos"], int]]:
    """Lay out each episode, and what stands beside it, on the same ground; and their last moment."""
    for k, episode in enumerate(episodes):
        note = f"episode {k + 1} of {len(episodes)}" if len(episodes) > 1 else ""
        if beside is None:
            yield [laid_out(episode, size, title, note, words)], episode.num_steps
            continue
        other = beside.episodes[k]
        pictures = [
            laid_out(episode, size, title, note, words, other.scene),
            laid_out(other, size, beside.title, note, words, episode.scene),
        ]
        yield pictures, max(episode.num_steps, other.num_steps)


def durations(episodes: Sequence[Episode], fps: int | float, beside: Beside | None = None) -> list[int]:
    """Return for how many milliseconds each frame of the episodes is seen.

    Raises ValueError without episodes, or for an impossible speed.
    """
    if not episodes:
        raise ValueError("a picture needs at least one episode")
    speed = typed(fps, float, "fps")
    if not 0 < speed <= 50:
        raise ValueError(f"fps must be above 0 and at most 50, not {fps}")
    others = episodes if beside is None else beside.episodes
    lengths = [max(one.num_steps, other.num_steps) for one, other in zip(episodes, others, strict=True)]
    return [pause for steps in lengths for pause in _durations(num_frames(steps), speed)]


def num_frames(num_steps: int) -> int:
    """Return how many frames a picture has of an episode of so many steps."""
    return min(num_steps + 1, MOST_FRAMES)


def _moments(num_steps: int) -> list[int]:
    """Before which steps the frames are; the first and the last moment are always among them."""
    return [round(moment) for moment in np.linspace(0, num_steps, num_frames(num_steps)).tolist()]


class _Film:
    """A GIF (version 89a) that is written frame by frame; no frame is kept but the one before.

    Pillow keeps all of them until it writes the first.
    """

    def __init__(self, file: BinaryIO, colours: Sequence[int]) -> None:
        """colours: at most 255, red, green and blue one after the other."""
        self._file = file
        self._unchanged = len(colours) // 3
        """The colour of a pixel that stays as it was."""
        self._colours = bytes(colours).ljust(3 * 256, b"\0")
        self._before: UInt8[np.ndarray, "height width"] | None = None

    def add(self, frame: UInt8[np.ndarray, "height width"], pause: int) -> None:
        """Write a frame that stays for so many milliseconds: where it differs from the one before."""
        if self._before is None:
            self._begin(*frame.shape)
            changed = np.ones_like(frame, bool)
        else:
            changed = frame != self._before
            changed[0, 0] |= not changed.any()  # also a frame in which nothing moves has its time
        rows, columns = np.flatnonzero(changed.any(1)), np.flatnonzero(changed.any(0))
        part = (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1))
        image = Image.fromarray(np.where(changed, frame, np.uint8(self._unchanged))[part])
        blocks = GifImagePlugin.getdata(
            image, (int(columns[0]), int(rows[0])), duration=pause, disposal=1, transparency=self._unchanged
        )
        self._file.writelines(blocks)
        self._before = frame

    def end(self) -> None:
        """Write what closes the file."""
        self._file.write(b";")

    def _begin(self, height: int, width: int) -> None:
        """Write the size, one table of 256 colours for all frames, and that they are shown again and again."""
        self._file.write(struct.pack("<6sHHBBB", b"GIF89a", width, height, 0b1111_0111, 0, 0) + self._colours)
        self._file.write(b"!\xff\x0bNETSCAPE2.0\x03\x01\x00\x00\x00")


def _durations(frames: int, fps: float) -> list[int]:
    """Milliseconds of each frame of an episode; GIF counts in hundredths of a second."""
    usual = round(100 / fps) * 10
    first, last = (max(usual, round(seconds * 1000)) for seconds in (_FIRST_SECONDS, _LAST_SECONDS))
    return [first, *[usual] * (frames - 2), last]


def _palette(samples: Iterable[Image.Image]) -> Image.Image:
    """One palette for all frames: the colours of surfaces exactly, those of their soft edges nearly.

    Few colours make a small file. Pillow looks the nearest one up on a coarse grid, so they keep apart: a
    surface would take on the colour of its edge.
    """
    counts: Counter[tuple[int, ...]] = Counter()
    for sample in samples:
        for count, colour in sample.getcolors(sample.width * sample.height) or ():
            assert isinstance(colour, tuple)
            counts[colour] += count
    named = [ImageColor.getrgb(colour) for colour in (*SYMBOL_COLOURS, COVERED, UNCOVERED, INK, PAPER)]
    common = [colour for colour, _ in counts.most_common(24)]
    strip = Image.fromarray(np.array(list(counts), np.uint8)[None])
    soft = strip.quantize(_COLOURS, Image.Quantize.MEDIANCUT).convert("RGB").getcolors() or []
    chosen: list[tuple[int, ...]] = []
    for colour in [*named, *common, *(soft_colour for _, soft_colour in soft)]:
        assert isinstance(colour, tuple)
        if all(math.dist(colour, other) > 12 for other in chosen):
            chosen.append(colour)
    palette = Image.new("P", (1, 1))
    palette.putpalette([part for colour in chosen[:255] for part in colour])
    return palette
