"""Pictures of episodes: one frame, a strip of several, or an animated GIF, drawn without a display.

What is drawn is a `gacrl.scene.Scene`: agents are discs with their number, speech bubbles hold the symbol that each one
sends, and marks are rings that turn green when lit. Colours can be told apart by the colour-blind, and nothing is said
by colour alone.
"""

import functools
import math
import struct
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, SupportsIndex, TypeAlias

import numpy as np
from jaxtyping import Float, UInt8
from PIL import GifImagePlugin, Image, ImageColor, ImageDraw, ImageFont

from gacrl.config.checks import typed, whole
from gacrl.evaluation.episodes import Episode, written_whole
from gacrl.scene import PLAIN, Scene
from gacrl.tasks.task import Words

SYMBOL_COLOURS = (
    "#1440b8",
    "#e89c14",
    "#8d3b82",
    "#5cc8f5",
    "#be5614",
    "#f5f527",
    "#3d3d3d",
    "#eeb7bd",
)
"""Of the symbols A to H, far apart for every kind of colour vision; later symbols begin again."""
COVERED, UNCOVERED = "#12936b", "#7b8590"
"""Of a landmark's ring."""

_INK, _FAINT, _PAPER, _OUTSIDE, _BORDER = "#1f2933", "#66717d", "#ffffff", "#eef0f3", "#d5dae0"
_BODY, _RIM, _TRAIL = "#c3d3e6", "#3f566e", "#6f93bd"
_SUPERSAMPLING = 3
_MARGIN = 0.04
"""Around everything, as a share of the picture's width."""
_TRAIL_STEPS = 8
_JUMP = 4.0
"""A step of this many radii is a new placement: no trail follows it."""
_ALARM = "#c0392b"
"""The rim of an agent that is lit."""
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

_Point: TypeAlias = tuple[float, float]
WORDS = Words()


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
    with written_whole(path) as file:
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
    with written_whole(path) as file:
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
) -> Iterator[tuple[list["_Picture | _Photos"], int]]:
    """Lay out each episode, and what stands beside it, on the same ground; and their last moment."""
    for k, episode in enumerate(episodes):
        note = f"episode {k + 1} of {len(episodes)}" if len(episodes) > 1 else ""
        if beside is None:
            yield [_picture(episode, size, title, note, words)], episode.num_steps
            continue
        other = beside.episodes[k]
        pictures = [
            _picture(episode, size, title, note, words, other.scene),
            _picture(other, size, beside.title, note, words, episode.scene),
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
    """How many frames a picture has of an episode of so many steps."""
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


def frame(episode: Episode, t: int, size: int = 480, title: str = "", words: Words = WORDS) -> Image.Image:
    """The world before step t (after the last one: t = T), `size` pixels wide."""
    if not 0 <= t <= episode.num_steps:
        raise ValueError(f"the episode has the frames 0 to {episode.num_steps}, not {t}")
    return _Picture(episode, size, title, "", words).draw(t)


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
    named = [ImageColor.getrgb(colour) for colour in (*SYMBOL_COLOURS, COVERED, UNCOVERED, _INK, _PAPER)]
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


def _view(*scenes: Scene) -> tuple[Float[np.ndarray, "2"], float]:
    """Centre and half the width of the square that holds all that happens in scenes, and all of the ground."""
    corners: list[Any] = []
    for scene in scenes:
        corners += [scene.lines.reshape(-1, 2)]
        corners += [scene.ground.reshape(-1, 2)] if _has_ground(scene) else []
        for group in (scene.agents, scene.marks):
            places, radius = group.positions[group.there], group.radius[group.there][:, None]
            corners += [places - radius, places + radius]
    everything = np.concatenate(corners)
    low, high = everything.min(0), everything.max(0)
    return (low + high) / 2, max(float((high - low).max() / 2), 1e-6)


def _has_ground(scene: Scene) -> bool:
    return bool((scene.ground[0, 1] > scene.ground[0, 0]).all())


def _picture(
    episode: Episode, size: int, title: str, note: str, words: Words, other: Scene | None = None
) -> "_Picture | _Photos":
    """Lay an episode out: as its environment drew it where there is no scene."""
    if episode.scene is None:
        return _Photos(episode, size)
    return _Picture(episode, size, title, note, words, other)


class _Photos:
    """An episode as its environment drew it."""

    def __init__(self, episode: Episode, size: int) -> None:
        if episode.frames is None:
            raise ValueError("the episode has no scene: there is nothing to draw")
        self._frames = episode.frames
        self._size = size, round(size * self._frames.shape[1] / self._frames.shape[2])

    def draw(self, t: int) -> Image.Image:
        """The frame before step t; the last one from the end on."""
        return Image.fromarray(self._frames[min(t, len(self._frames) - 1)]).resize(self._size)


class _Picture:
    """An episode laid out for drawing. The layout is made for a width of 480 pixels and scales with it."""

    def __init__(
        self,
        episode: Episode,
        size: int,
        title: str = "",
        note: str = "",
        words: Words = WORDS,
        other: Scene | None = None,
    ) -> None:
        """other: a scene for which there is room as well."""
        if not 120 <= size <= 4096:
            raise ValueError(f"the size of a picture must be between 120 and 4096 pixels, not {size}")
        if episode.scene is None:
            raise ValueError("the episode has no scene: there is nothing to draw")
        self.episode, self._words, self._view = episode, words, episode.scene
        self._size, self._unit = size, size / 480
        self._return, self._symbols = episode.return_so_far, episode.symbols

        centre, reach = _view(self._view, *(() if other is None else (other,)))
        side = size * _SUPERSAMPLING
        self._scale = side * (0.5 - _MARGIN) / reach
        upwards = np.array([1.0, -1.0])

        def placed(points: Any) -> Float[np.ndarray, "..."]:
            return side / 2 + (points - centre) * upwards * self._scale

        self._discs, self._rings = placed(self._view.agents.positions), placed(self._view.marks.positions)
        self._lines = placed(self._view.lines)
        self._ground = Image.new("RGB", (side, side), _OUTSIDE if _has_ground(self._view) else _PAPER)
        if _has_ground(self._view):
            self._lay_ground(placed(self._view.ground[0]))
        self._header, self._footer = self._px(38), self._px(38) + size
        self._page = Image.new("RGB", (size, self._footer + self._px(92)), _PAPER)
        self._lay_out(ImageDraw.Draw(self._page), title, note)

    def _lay_ground(self, corners: Float[np.ndarray, "2 2"]) -> None:
        """Where everything starts."""
        ground = ImageDraw.Draw(self._ground)
        (left, bottom), (right, top) = corners.tolist()
        ground.rectangle((left, top, right, bottom), _PAPER)
        inset, small = 5 * self._unit * _SUPERSAMPLING, _font(self._px(9) * _SUPERSAMPLING)
        if 4 * small.getlength("start area") < right - left:
            ground.text((right - inset, bottom - inset), "start area", UNCOVERED, small, "rb")

    def draw(self, t: int) -> Image.Image:
        """The frame before step t; once the episode is over its last one."""
        t = min(t, self.episode.num_steps)
        page = self._page.copy()
        page.paste(self._scene(t), (0, self._header))
        draw, px = ImageDraw.Draw(page), self._px
        steps, y = self.episode.num_steps, self._footer
        marks = self._view.marks
        count = f"{(marks.lit & marks.there)[t].sum()} / {marks.there[t].sum()}"
        values = (
            f"{t} / {steps}",
            count if marks.there.any() else "",
            f"{self._return[t]:.1f}".replace("-", "−"),
        )
        for (x, anchor), value in zip(self._columns(), values, strict=True):
            draw.text((x, y + px(36)), value, _INK, _font(px(17), True), anchor)
        draw.rectangle((0, y, self._size, y + px(3) - 1), _BORDER)
        if t:
            draw.rectangle((0, y, self._size * t / steps, y + px(3) - 1), _RIM)
        return page

    def _px(self, length: int) -> int:
        return round(length * self._unit)

    def _columns(self) -> tuple[tuple[int, str], ...]:
        """Where the footer's numbers stand, and which side of them."""
        return (self._px(16), "lm"), (self._size // 2, "mm"), (self._size - self._px(16), "rm")

    def _lay_out(self, draw: ImageDraw.ImageDraw, title: str, note: str) -> None:
        """What no step changes: title, captions and legend."""
        px, small = self._px, _font(self._px(11))
        title = " ".join(title.split())
        marks = int(self._view.marks.there.any(0).sum())
        if not title:
            title = _count(int(self._view.agents.there.any(0).sum()), self._words.agent)
            title += f", {_count(marks, self._words.mark)}" if marks else ""
        bold, room = _font(px(14), True), self._size - px(44) - small.getlength(note)
        while bold.getlength(title) > room:
            title = title.rstrip("…")[:-1] + "…"
        draw.text((px(16), px(19)), title, _INK, bold, "lm")
        draw.text((self._size - px(16), px(19)), note, _FAINT, small, "rm")
        captions = ("step", f"{self._words.mark}s {self._words.lit}" if marks else "", "return so far")
        for (x, anchor), caption in zip(self._columns(), captions, strict=True):
            draw.text((x, self._footer + px(17)), caption, _FAINT, small, anchor)

        kinds = {"agent": self._words.agent}
        kinds |= {"mark": self._words.mark, "lit": self._words.lit} if marks else {}
        kinds |= {} if self.episode.adjacency is None else {"edge": "can hear"}
        kinds |= {} if self._symbols is None or (self._symbols < 0).all() else {"message": "message"}
        words = list(kinds.values())
        icon = px(20)
        widths = [icon + px(5) + small.getlength(word) for word in words]
        gap = min(px(30), (self._size - px(24) - sum(widths)) / len(words))
        x, y = (self._size - sum(widths) - gap * (len(words) - 1)) / 2, self._footer + px(75)
        draw.line((px(16), y - px(18), self._size - px(16), y - px(18)), _BORDER, max(1, px(1)))
        for (kind, word), width in zip(kinds.items(), widths, strict=True):
            self._page.paste(self._specimen(kind, icon), (round(x), y - icon // 2))
            draw.text((x + icon + px(5), y), word, _INK, small, "lm")
            x += width + gap

    def _specimen(self, kind: str, size: int) -> Image.Image:
        """What the legend shows beside a word."""
        side = float(size * _SUPERSAMPLING)
        image = Image.new("RGB", (round(side), round(side)), _PAPER)
        pen, middle = _Pen(image, self._unit), (side / 2, side / 2)
        if kind == "agent":
            pen.disc(middle, side * 0.44)
            pen.number(middle, side * 0.44, "1")
        elif kind == "edge":
            pen.edge((0.0, side * 0.75), (side, side * 0.25), 120)
        elif kind == "message":
            pen.bubbles((side * 0.1, side * 0.95), side * 0.36, [0], side * 0.45)
        else:
            pen.landmark(middle, side * 0.36, kind == "lit")
            pen.ring(middle, side * 0.36, kind == "lit")
        return image.reduce(_SUPERSAMPLING)

    def _scene(self, t: int) -> Image.Image:
        image = self._ground.copy()
        pen, agents, marks = _Pen(image, self._unit), self._view.agents, self._view.marks
        discs: list[_Point] = [(x, y) for x, y in self._discs[t].tolist()]
        rings: list[_Point] = [(x, y) for x, y in self._rings[t].tolist()]
        sizes: list[float] = (agents.radius[t] * self._scale).tolist()
        reach: list[float] = (marks.radius[t] * self._scale).tolist()
        seen: list[int] = np.flatnonzero(agents.there[t]).tolist()
        places: list[int] = np.flatnonzero(marks.there[t]).tolist()

        for start, end in self._lines[t].tolist():
            pen.road(start, end)
        for i in seen:
            pen.trail(self._trail(t, i), sizes[i])
        self._edges(pen, t, discs, sizes)
        for j in places:
            pen.landmark(rings[j], reach[j], bool(marks.lit[t, j]), int(marks.colour[t, j]))
        for i in seen:
            pen.disc(discs[i], sizes[i], int(agents.colour[t, i]), bool(agents.lit[t, i]))
        for j in places:
            pen.ring(rings[j], reach[j], bool(marks.lit[t, j]))
        for i in seen:
            pen.number(discs[i], sizes[i], str(i))
        if self._symbols is not None:
            spoken = self._symbols[self._now(t)]
            for i in seen:
                pen.bubbles(discs[i], sizes[i], [symbol for symbol in spoken[:, i].tolist() if symbol >= 0])
        return image.reduce(_SUPERSAMPLING)

    def _now(self, t: int) -> int:
        """The step whose words and graph are shown: nothing is said after the end, the last words stay."""
        return min(t, self.episode.num_steps - 1)

    def _trail(self, t: int, agent: int) -> list[list[float]]:
        """Where an agent came from, as far as it has been there all the time."""
        there = self._view.agents.there[max(0, t - _TRAIL_STEPS) : t + 1, agent]
        since = len(there) - 1 - int(np.argmin(there[::-1])) + 1 if not there.all() else 0
        return self._discs[max(0, t - _TRAIL_STEPS) + since : t + 1, agent].tolist()

    def _edges(self, pen: "_Pen", t: int, discs: Sequence[_Point], sizes: Sequence[float]) -> None:
        """Who hears whom."""
        if self.episode.adjacency is None:
            return
        there = self._view.agents.there[t]
        hears = self.episode.adjacency[self._now(t)] & there[:, None] & there[None, :]
        strength = max(50, min(120, 4000 // max(int(hears.sum()), 1)))
        for i, j in np.argwhere(hears).tolist():
            if i < j or not hears[j, i]:
                pen.edge(discs[j], discs[i], strength, None if hears[j, i] else sizes[i])


class _Pen:
    """Draws the things of the world on a supersampled image. Points and radii in its pixels."""

    def __init__(self, image: Image.Image, unit: float) -> None:
        self._draw = ImageDraw.Draw(image, "RGBA")
        self._unit = unit * _SUPERSAMPLING
        """One pixel of the layout."""

    def trail(self, points: Sequence[Sequence[float]], radius: float) -> None:
        """Where an agent came from: the older, the fainter."""
        for age, ((x0, y0), (x1, y1)) in enumerate(zip(points[-2::-1], points[:0:-1], strict=True)):
            if 0 < math.hypot(x1 - x0, y1 - y0) < _JUMP * radius:
                strength = round(220 * (1 - age / _TRAIL_STEPS))
                self._draw.line((x0, y0, x1, y1), _see_through(_TRAIL, strength), self._width(3))

    def edge(self, sender: _Point, receiver: _Point, strength: int, arrow_at: float | None = None) -> None:
        """A line between two who hear each other; an arrow, this far from its end, where only one does."""
        self._draw.line((*sender, *receiver), _see_through(_RIM, strength), self._width(1.5))
        if arrow_at is not None:
            angle = math.atan2(receiver[1] - sender[1], receiver[0] - sender[0])
            tip = _towards(receiver, angle, -arrow_at)
            wings = [_towards(tip, angle + turn, -7 * self._unit) for turn in (0.45, -0.45)]
            self._draw.polygon([tip, *wings], _RIM)

    def road(self, start: Sequence[float], end: Sequence[float]) -> None:
        """A line of the ground, from where to where."""
        self._draw.line((*start, *end), _BORDER, self._width(2))

    def landmark(self, point: _Point, radius: float, covered: bool, colour: int = PLAIN) -> None:
        """A cross in a dashed ring, or a green disc; one with a colour of its own is drawn in it."""
        ink = UNCOVERED if colour == PLAIN else SYMBOL_COLOURS[colour % len(SYMBOL_COLOURS)]
        if covered:
            self._circle(point, radius, fill=_see_through(COVERED, 90))
            if colour == PLAIN:
                return
        for start in range(0, 360, 30):
            self._draw.arc(_box(point, radius), start, start + 18, ink, self._width(1.5 if colour == PLAIN else 3))
        for angle in (0.0, math.pi / 2):
            ends = (*_towards(point, angle, radius * 0.3), *_towards(point, angle, -radius * 0.3))
            self._draw.line(ends, ink, self._width(1.5 if colour == PLAIN else 3))

    def ring(self, point: _Point, radius: float, covered: bool) -> None:
        """What marks a covered landmark through the agent that stands on it."""
        if covered:
            self._circle(point, radius, outline=COVERED, width=self._width(3))

    def disc(self, point: _Point, radius: float, colour: int = PLAIN, alarm: bool = False) -> None:
        """An agent; the rim has its own colour, or that of an alarm."""
        own = _RIM if colour == PLAIN else SYMBOL_COLOURS[colour % len(SYMBOL_COLOURS)]
        width = 1.5 if colour == PLAIN and not alarm else 3
        self._circle(point, radius, _see_through(_BODY, 200), _ALARM if alarm else own, self._width(width))

    def number(self, point: _Point, radius: float, text: str) -> None:
        size = max(radius * (0.85 if len(text) < 2 else 0.7), 7 * self._unit)
        self._draw.text(point, text, _INK, _font(round(size), True), "mm")

    def bubbles(self, speaker: _Point, radius: float, symbols: Sequence[int], size: float | None = None) -> None:
        """Draw speech bubbles at the upper right of a disc: a symbol's letter and colour for each round."""
        if not symbols:
            return
        size = max(radius * 0.42, 6.5 * self._unit) if size is None else size
        angle, rim = -math.pi / 4, self._width(1.2)
        x, y = point = _towards(speaker, angle, radius + size * 0.75)
        tail = [_towards(speaker, angle, radius * 0.7)]
        tail += [_towards(point, angle + turn, size * 0.8) for turn in (2.2, -2.2)]
        self._draw.polygon(tail, _PAPER, _PAPER, 2 * rim)
        places = [(x + 1.8 * size * number, y) for number in range(len(symbols))]
        for place in places:
            self._circle(place, size + rim, fill=_PAPER)
        self._draw.polygon(tail, SYMBOL_COLOURS[symbols[0] % len(SYMBOL_COLOURS)])
        for place, symbol in zip(places, symbols, strict=True):
            colour = SYMBOL_COLOURS[symbol % len(SYMBOL_COLOURS)]
            self._circle(place, size, fill=colour)
            letter = chr(ord("A") + symbol % 26) + (str(symbol // 26) if symbol >= 26 else "")
            font = _font(round(size * (1.35 if len(letter) < 2 else 0.95)), True)
            self._draw.text(place, letter, _readable_on(colour), font, "mm")

    def _circle(
        self,
        point: _Point,
        radius: float,
        fill: tuple[int, ...] | str | None = None,
        outline: str | None = None,
        width: int = 1,
    ) -> None:
        self._draw.ellipse(_box(point, radius), fill, outline, width)

    def _width(self, width: int | float) -> int:
        return max(1, round(width * self._unit))


def _box(point: _Point, radius: float) -> tuple[float, float, float, float]:
    (x, y) = point
    return x - radius, y - radius, x + radius, y + radius


def _towards(point: _Point, angle: float, distance: float) -> _Point:
    return point[0] + math.cos(angle) * distance, point[1] + math.sin(angle) * distance


def _see_through(colour: str, alpha: int) -> tuple[int, ...]:
    return *ImageColor.getrgb(colour)[:3], alpha


def _readable_on(colour: str) -> str:
    """Ink or paper, whichever stands out more."""
    red, green, blue = ImageColor.getrgb(colour)[:3]
    return _INK if 0.299 * red + 0.587 * green + 0.114 * blue > 140 else _PAPER


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


@functools.cache
def _font(size: int, bold: bool = False) -> ImageFont.FreeTypeFont:
    """DejaVu Sans, which comes with matplotlib: the same everywhere, and it has every letter of a title."""
    import matplotlib  # a fifth of a second, which no run waits for at its start

    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(Path(matplotlib.get_data_path(), "fonts", "ttf", name), max(size, 1))
