"""Draws the things of a scene: agents, places, edges, words. Colours that the colour-blind can tell apart."""

import functools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TypeAlias

from PIL import Image, ImageColor, ImageDraw, ImageFont

from gacrl.scene import PLAIN

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

INK, FAINT, PAPER, OUTSIDE, BORDER = "#1f2933", "#66717d", "#ffffff", "#eef0f3", "#d5dae0"
_BODY, RIM, _TRAIL = "#c3d3e6", "#3f566e", "#6f93bd"
SUPERSAMPLING = 3
TRAIL_STEPS = 8
_JUMP = 4.0
"""A step of this many radii is a new placement: no trail follows it."""
_ALARM = "#c0392b"
"""The rim of an agent that is lit."""
Point: TypeAlias = tuple[float, float]


class Pen:
    """Draws the things of the world on a supersampled image. Points and radii in its pixels."""

    def __init__(self, image: Image.Image, unit: float) -> None:
        self._draw = ImageDraw.Draw(image, "RGBA")
        self._unit = unit * SUPERSAMPLING
        """One pixel of the layout."""

    def trail(self, points: Sequence[Sequence[float]], radius: float) -> None:
        """Draw where an agent came from: the older, the fainter."""
        for age, ((x0, y0), (x1, y1)) in enumerate(zip(points[-2::-1], points[:0:-1], strict=True)):
            if 0 < math.hypot(x1 - x0, y1 - y0) < _JUMP * radius:
                strength = round(220 * (1 - age / TRAIL_STEPS))
                self._draw.line((x0, y0, x1, y1), _see_through(_TRAIL, strength), self._width(3))

    def edge(self, sender: Point, receiver: Point, strength: int, arrow_at: float | None = None) -> None:
        """Draw a line between two who hear each other; an arrow, this far from its end, where only one does."""
        self._draw.line((*sender, *receiver), _see_through(RIM, strength), self._width(1.5))
        if arrow_at is not None:
            angle = math.atan2(receiver[1] - sender[1], receiver[0] - sender[0])
            tip = _towards(receiver, angle, -arrow_at)
            wings = [_towards(tip, angle + turn, -7 * self._unit) for turn in (0.45, -0.45)]
            self._draw.polygon([tip, *wings], RIM)

    def road(self, start: Sequence[float], end: Sequence[float]) -> None:
        """Draw a line of the ground, from where to where."""
        self._draw.line((*start, *end), BORDER, self._width(2))

    def landmark(self, point: Point, radius: float, covered: bool, colour: int = PLAIN) -> None:
        """Draw a cross in a dashed ring, or a green disc; one with a colour of its own is drawn in it."""
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

    def ring(self, point: Point, radius: float, covered: bool) -> None:
        """Draw what marks a covered landmark through the agent that stands on it."""
        if covered:
            self._circle(point, radius, outline=COVERED, width=self._width(3))

    def disc(self, point: Point, radius: float, colour: int = PLAIN, alarm: bool = False) -> None:
        """Draw an agent; the rim has its own colour, or that of an alarm."""
        own = RIM if colour == PLAIN else SYMBOL_COLOURS[colour % len(SYMBOL_COLOURS)]
        width = 1.5 if colour == PLAIN and not alarm else 3
        self._circle(point, radius, _see_through(_BODY, 200), _ALARM if alarm else own, self._width(width))

    def number(self, point: Point, radius: float, text: str) -> None:
        size = max(radius * (0.85 if len(text) < 2 else 0.7), 7 * self._unit)
        self._draw.text(point, text, INK, typeface(round(size), True), "mm")

    def bubbles(self, speaker: Point, radius: float, symbols: Sequence[int], size: float | None = None) -> None:
        """Draw speech bubbles at the upper right of a disc: a symbol's letter and colour for each round."""
        if not symbols:
            return
        size = max(radius * 0.42, 6.5 * self._unit) if size is None else size
        angle, rim = -math.pi / 4, self._width(1.2)
        x, y = point = _towards(speaker, angle, radius + size * 0.75)
        tail = [_towards(speaker, angle, radius * 0.7)]
        tail += [_towards(point, angle + turn, size * 0.8) for turn in (2.2, -2.2)]
        self._draw.polygon(tail, PAPER, PAPER, 2 * rim)
        places = [(x + 1.8 * size * number, y) for number in range(len(symbols))]
        for place in places:
            self._circle(place, size + rim, fill=PAPER)
        self._draw.polygon(tail, SYMBOL_COLOURS[symbols[0] % len(SYMBOL_COLOURS)])
        for place, symbol in zip(places, symbols, strict=True):
            colour = SYMBOL_COLOURS[symbol % len(SYMBOL_COLOURS)]
            self._circle(place, size, fill=colour)
            letter = chr(ord("A") + symbol % 26) + (str(symbol // 26) if symbol >= 26 else "")
            font = typeface(round(size * (1.35 if len(letter) < 2 else 0.95)), True)
            self._draw.text(place, letter, _readable_on(colour), font, "mm")

    def _circle(
        self,
        point: Point,
        radius: float,
        fill: tuple[int, ...] | str | None = None,
        outline: str | None = None,
        width: int = 1,
    ) -> None:
        self._draw.ellipse(_box(point, radius), fill, outline, width)

    def _width(self, width: int | float) -> int:
        return max(1, round(width * self._unit))


def _box(point: Point, radius: float) -> tuple[float, float, float, float]:
    (x, y) = point
    return x - radius, y - radius, x + radius, y + radius


def _towards(point: Point, angle: float, distance: float) -> Point:
    return point[0] + math.cos(angle) * distance, point[1] + math.sin(angle) * distance


def _see_through(colour: str, alpha: int) -> tuple[int, ...]:
    return *ImageColor.getrgb(colour)[:3], alpha


def _readable_on(colour: str) -> str:
    """Ink or paper, whichever stands out more."""
    red, green, blue = ImageColor.getrgb(colour)[:3]
    return INK if 0.299 * red + 0.587 * green + 0.114 * blue > 140 else PAPER


@functools.cache
def typeface(size: int, bold: bool = False) -> ImageFont.FreeTypeFont:
    """Return DejaVu Sans, which comes with matplotlib: the same everywhere, and it has every letter of a title."""
    import matplotlib  # a fifth of a second, which no run waits for at its start

    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(Path(matplotlib.get_data_path(), "fonts", "ttf", name), max(size, 1))
