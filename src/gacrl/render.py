"""Pictures of episodes: one frame, or an animated GIF of several, drawn without a display.

Agents are discs of their true size with their number, speech bubbles hold the symbol that each one sends, and
landmarks are rings of the capture radius that turn green when covered. Colours can be told apart by the
colour-blind, and nothing is said by colour alone.
"""

import functools
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import matplotlib
import numpy as np
from PIL import Image, ImageColor, ImageDraw, ImageFont

from gacrl.evaluation.episodes import Episode, written_whole

SYMBOL_COLOURS = (
    "#0072b2",
    "#e69f00",
    "#a6357a",
    "#56b4e9",
    "#d55e00",
    "#f0e442",
    "#3d3d3d",
    "#cc99cc",
)
"""Of the symbols A to H, after Okabe and Ito but for the green; later symbols begin again."""
COVERED, UNCOVERED = "#12936b", "#87909a"
"""Of a landmark's ring."""

_INK, _FAINT, _PAPER, _OUTSIDE, _BORDER = "#1f2933", "#66717d", "#ffffff", "#eef0f3", "#d5dae0"
_BODY, _RIM = "#c3d3e6", "#3f566e"
_BODY_ALPHA, _EDGE_ALPHA = 205, 130
_SUPERSAMPLING = 3
_MARGIN = 0.04
"""Around everything, as a share of the picture's width."""
_TRAIL_STEPS = 8
_JUMP = 4.0
"""A step of this many radii is a new placement: no trail follows it."""
_FIRST_SECONDS, _LAST_SECONDS = 0.6, 1.5
"""How long an episode's first and last frame stay."""

_Point = tuple[float, float]


def gif(episodes: Sequence[Episode], path: Path, size: int = 480, fps: float = 10, title: str = "") -> None:
    """Write the episodes, one after the other, as an animated GIF that is `size` pixels wide.

    Raises OSError where the file cannot be written, ValueError for no episodes or an impossible size or speed.
    """
    if not episodes:
        raise ValueError("a GIF needs at least one episode")
    if not 0 < fps <= 50:
        raise ValueError(f"fps must be above 0 and at most 50, not {fps}")
    numbered = [f"episode {k} of {len(episodes)}" for k in range(1, len(episodes) + 1)]
    pictures = [
        _Picture(episode, size, title, note if len(episodes) > 1 else "")
        for episode, note in zip(episodes, numbered, strict=True)
    ]
    moments = [(picture, t) for picture in pictures for t in range(picture.episode.num_steps + 1)]
    with written_whole(path) as file:
        palette = _palette([picture.draw(t) for picture, t in moments[:: -(-len(moments) // 8)]])
        frames = (
            picture.draw(t).quantize(palette=palette, dither=Image.Dither.NONE) for picture, t in moments
        )
        durations = [pause for episode in episodes for pause in _durations(episode.num_steps, fps)]
        next(frames).save(
            file, format="GIF", save_all=True, append_images=frames, duration=durations, loop=0
        )


def frame(episode: Episode, t: int, size: int = 480, title: str = "") -> Image.Image:
    """The world before step t (after the last one: t = T), `size` pixels wide."""
    if not 0 <= t <= episode.num_steps:
        raise ValueError(f"the episode has the frames 0 to {episode.num_steps}, not {t}")
    return _Picture(episode, size, title).draw(t)


def _durations(num_steps: int, fps: float) -> list[int]:
    """Milliseconds of each frame of an episode; GIF counts in hundredths of a second."""
    usual = round(100 / fps) * 10
    first, last = (max(usual, round(seconds * 1000)) for seconds in (_FIRST_SECONDS, _LAST_SECONDS))
    return [first, *[usual] * (num_steps - 1), last]


def _palette(samples: Sequence[Image.Image]) -> Image.Image:
    """One palette for all frames: the named colours and the commonest exactly, the rest nearly.

    255 colours: the last entry is left for the pixels that stay as they were.
    """
    counts: Counter[tuple[int, int, int]] = Counter()
    for sample in samples:
        for count, colour in sample.getcolors(sample.width * sample.height) or ():
            assert isinstance(colour, tuple)
            counts[colour[:3]] += count
    named = [ImageColor.getrgb(colour)[:3] for colour in (*SYMBOL_COLOURS, COVERED, UNCOVERED, _BODY)]
    exact = list(dict.fromkeys([*named, *(colour for colour, _ in counts.most_common(80))]))
    rest = np.array([colour for colour in counts if colour not in set(exact)], np.uint8).reshape(-1, 1, 3)
    if len(rest):
        mixed = Image.fromarray(rest).quantize(255 - len(exact), Image.Quantize.MEDIANCUT).getpalette() or []
    else:
        mixed = []
    palette = Image.new("P", (1, 1))
    palette.putpalette([part for colour in exact for part in colour] + mixed)
    return palette


class _Picture:
    """An episode laid out for drawing: where things are, and what no step changes."""

    def __init__(self, episode: Episode, size: int, title: str = "", note: str = "") -> None:
        if not 120 <= size <= 4096:
            raise ValueError(f"the size of a picture must be between 120 and 4096 pixels, not {size}")
        self.episode = episode
        self._size = size
        self._unit = size / 480
        self._header = self._px(38)
        self._agents: list[int] = np.flatnonzero(episode.agent_mask).tolist()
        self._landmarks: list[int] = np.flatnonzero(episode.landmark_mask).tolist()
        self._covered, self._return = episode.covered, episode.return_so_far
        self._symbols = episode.symbols
        centre, reach = _view(episode)
        self._scale = size * _SUPERSAMPLING * (0.5 - _MARGIN) / reach
        flip = np.array([1.0, -1.0])
        middle = size * _SUPERSAMPLING / 2
        self._positions = middle + (episode.positions - centre) * flip * self._scale
        self._places = middle + (episode.landmarks - centre) * flip * self._scale
        self._origin = middle - centre * flip * self._scale
        self._radius = episode.agent_radius * self._scale
        self._ground = self._draw_ground()
        self._page = self._draw_page(title, note)

    def draw(self, t: int) -> Image.Image:
        """The frame before step t."""
        page = self._page.copy()
        page.paste(self._draw_scene(t).reduce(_SUPERSAMPLING), (0, self._header))
        self._draw_footer(ImageDraw.Draw(page), t)
        return page

    def _px(self, length: float) -> int:
        """A length of the layout, made for 480 pixels of width."""
        return round(length * self._unit)

    def _fine(self, length: float) -> float:
        """The same in the supersampled scene."""
        return length * self._unit * _SUPERSAMPLING

    def _draw_ground(self) -> Image.Image:
        side = self._size * _SUPERSAMPLING
        ground = Image.new("RGB", (side, side), _OUTSIDE)
        reach = self.episode.arena_scale * self._scale
        (x, y), corner = self._origin.tolist(), self._fine(4)
        ImageDraw.Draw(ground).rounded_rectangle(
            (x - reach, y - reach, x + reach, y + reach), corner, _PAPER, _BORDER, round(self._fine(1))
        )
        return ground

    def _draw_page(self, title: str, note: str) -> Image.Image:
        """Title, footer's captions, and the legend."""
        episode, px = self.episode, self._px
        page = Image.new("RGB", (self._size, self._header + self._size + px(92)), _PAPER)
        draw = ImageDraw.Draw(page)
        heading = title or f"{len(self._agents)} agents, {len(self._landmarks)} landmarks"
        note_width = _font(px(11)).getlength(note)
        room = self._size - px(32) - note_width - (px(12) if note else 0)
        draw.text((px(16), px(19)), _shorten(heading, px(14), room), _INK, _font(px(14), True), "lm")
        draw.text((self._size - px(16), px(20)), note, _FAINT, _font(px(11)), "rm")
        caption_y = self._header + self._size + px(16)
        for x, anchor, caption in self._columns():
            draw.text((x, caption_y), caption, _FAINT, _font(px(10)), anchor)
        ruler = self._header + self._size + px(57)
        draw.line((px(16), ruler, self._size - px(16), ruler), _BORDER, max(1, px(1)))

        items = ["agent", "landmark", "covered"]
        items += [] if episode.adjacency is None else ["can hear"]
        items += [] if episode.messages is None else ["message"]
        font, icon = _font(px(11)), px(20)
        widths = [icon + px(5) + font.getlength(item) for item in items]
        gap = min(px(30), (self._size - px(32) - sum(widths)) / max(len(items) - 1, 1))
        x, y = (self._size - sum(widths) - gap * (len(items) - 1)) / 2, ruler + px(18)
        for item, width in zip(items, widths, strict=True):
            page.paste(self._icon(item, icon), (round(x), y - icon // 2))
            draw.text((x + icon + px(5), y), item, _INK, font, "lm")
            x += width + gap
        return page

    def _columns(self) -> tuple[tuple[int, str, str], ...]:
        """Of the footer: x, anchor and caption."""
        return (
            (self._px(16), "lm", "step"),
            (self._size // 2, "mm", "landmarks covered"),
            (self._size - self._px(16), "rm", "return so far"),
        )

    def _draw_footer(self, draw: ImageDraw.ImageDraw, t: int) -> None:
        px, bottom = self._px, self._header + self._size
        steps = self.episode.num_steps
        values = (
            f"{t} / {steps}",
            f"{self._covered[t].sum()} / {len(self._landmarks)}",
            f"{self._return[t]:.1f}".replace("-", "−"),
        )
        for (x, anchor, _), value in zip(self._columns(), values, strict=True):
            draw.text((x, bottom + px(36)), value, _INK, _font(px(17), True), anchor)
        draw.rectangle((0, bottom, self._size - 1, bottom + px(3) - 1), _BORDER)
        draw.rectangle((0, bottom, round(self._size * t / steps) - 1, bottom + px(3) - 1), _RIM)

    def _icon(self, item: str, size: int) -> Image.Image:
        """A specimen for the legend."""
        side = size * _SUPERSAMPLING
        image = Image.new("RGB", (side, side), _PAPER)
        draw, middle = ImageDraw.Draw(image, "RGBA"), (side / 2, side / 2)
        if item == "agent":
            self._draw_agent(draw, middle, side * 0.42, "0")
        elif item in ("landmark", "covered"):
            self._draw_landmark(draw, middle, side * 0.36, item == "covered")
            self._draw_ring(draw, middle, side * 0.36, item == "covered")
        elif item == "can hear":
            self._draw_edge(draw, (0, side * 0.7), (side, side * 0.3))
        else:
            self._draw_bubble(draw, (side * 0.1, side * 0.9), side * 0.3, side * 0.38, 0)
        return image.reduce(_SUPERSAMPLING)

    def _draw_scene(self, t: int) -> Image.Image:
        episode = self.episode
        scene = self._ground.copy()
        draw = ImageDraw.Draw(scene, "RGBA")
        said = min(t, episode.num_steps - 1)  # nothing is said after the end: the last words stay
        here = {i: self._point(self._positions[t, i]) for i in self._agents}
        places = [(self._point(self._places[t, j]), bool(self._covered[t, j])) for j in self._landmarks]
        capture = episode.capture_radius * self._scale

        self._draw_trails(draw, t)
        if episode.adjacency is not None:
            for i, j in np.argwhere(episode.adjacency[said]).tolist():
                both = episode.adjacency[said, j, i]
                if i < j or not both:
                    self._draw_edge(draw, here[j], here[i], one_way=not both)
        for place, covered in places:
            self._draw_landmark(draw, place, capture, covered)
        for i, point in here.items():
            self._draw_agent(draw, point, self._radius, "")
        for place, covered in places:
            self._draw_ring(draw, place, capture, covered)
        for i, point in here.items():
            self._draw_number(draw, point, self._radius, str(i))
        if self._symbols is not None:
            bubble = max(self._radius * 0.42, self._fine(6))
            for i, point in here.items():
                self._draw_bubble(draw, point, self._radius, bubble, int(self._symbols[said, i]))
        return scene
