"""Pictures of a moment of an episode, drawn without a display.

What is drawn is a `gacrl.scene.Scene`: agents are discs with their number, speech bubbles hold the symbol that each one
sends, and marks are rings that turn green when lit. Colours can be told apart by the colour-blind, and nothing is said
by colour alone.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from PIL import Image, ImageDraw

from gacrl.evaluation.episodes import Episode
from gacrl.pen import (
    BORDER,
    FAINT,
    INK,
    OUTSIDE,
    PAPER,
    RIM,
    SUPERSAMPLING,
    TRAIL_STEPS,
    UNCOVERED,
    Pen,
    Point,
    typeface,
)
from gacrl.scene import Scene
from gacrl.tasks.task import Words

_MARGIN = 0.04
"""Around everything, as a share of the picture's width."""
WORDS = Words()


def frame(episode: Episode, t: int, size: int = 480, title: str = "", words: Words = WORDS) -> Image.Image:
    """Draw the world before step t (after the last one: t = T), `size` pixels wide."""
    if not 0 <= t <= episode.num_steps:
        raise ValueError(f"the episode has the frames 0 to {episode.num_steps}, not {t}")
    return Picture(episode, size, title, "", words).draw(t)


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


def laid_out(
    episode: Episode, size: int, title: str, note: str, words: Words, other: Scene | None = None
) -> "Picture | Photos":
    """Lay an episode out: as its environment drew it where there is no scene."""
    if episode.scene is None:
        return Photos(episode, size)
    return Picture(episode, size, title, note, words, other)


class Photos:
    """An episode as its environment drew it."""

    def __init__(self, episode: Episode, size: int) -> None:
        if episode.frames is None:
            raise ValueError("the episode has no scene: there is nothing to draw")
        self._frames = episode.frames
        self._size = size, round(size * self._frames.shape[1] / self._frames.shape[2])

    def draw(self, t: int) -> Image.Image:
        """Draw the frame before step t; the last one from the end on."""
        return Image.fromarray(self._frames[min(t, len(self._frames) - 1)]).resize(self._size)


class Picture:
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
        self._counted, self._counts = self._counting()

        centre, reach = _view(self._view, *(() if other is None else (other,)))
        side = size * SUPERSAMPLING
        self._scale = side * (0.5 - _MARGIN) / reach
        upwards = np.array([1.0, -1.0])

        def placed(points: Any) -> Float[np.ndarray, "..."]:
            return side / 2 + (points - centre) * upwards * self._scale

        self._discs, self._rings = placed(self._view.agents.positions), placed(self._view.marks.positions)
        self._lines = placed(self._view.lines)
        self._ground = Image.new("RGB", (side, side), OUTSIDE if _has_ground(self._view) else PAPER)
        if _has_ground(self._view):
            self._lay_ground(placed(self._view.ground[0]))
        self._header, self._footer = self._px(38), self._px(38) + size
        self._page = Image.new("RGB", (size, self._footer + self._px(92)), PAPER)
        self._lay_out(ImageDraw.Draw(self._page), title, note)

    def _lay_ground(self, corners: Float[np.ndarray, "2 2"]) -> None:
        """Where everything starts."""
        ground = ImageDraw.Draw(self._ground)
        (left, bottom), (right, top) = corners.tolist()
        ground.rectangle((left, top, right, bottom), PAPER)
        inset, small = 5 * self._unit * SUPERSAMPLING, typeface(self._px(9) * SUPERSAMPLING)
        if 4 * small.getlength("start area") < right - left:
            ground.text((right - inset, bottom - inset), "start area", UNCOVERED, small, "rb")

    def draw(self, t: int) -> Image.Image:
        """Draw the frame before step t; once the episode is over its last one."""
        t = min(t, self.episode.num_steps)
        page = self._page.copy()
        page.paste(self._scene(t), (0, self._header))
        draw, px = ImageDraw.Draw(page), self._px
        steps, y = self.episode.num_steps, self._footer
        values = (
            f"{t} / {steps}",
            self._counts[t],
            f"{round(self._return[t], 1) + 0.0:.1f}".replace("-", "−"),  # never −0.0
        )
        for (x, anchor), value in zip(self._columns(), values, strict=True):
            draw.text((x, y + px(36)), value, INK, typeface(px(17), True), anchor)
        draw.rectangle((0, y, self._size, y + px(3) - 1), BORDER)
        if t:
            draw.rectangle((0, y, self._size * t / steps, y + px(3) - 1), RIM)
        return page

    def _counting(self) -> tuple[str, list[str]]:
        """What the footer counts, and how much at each step: agents at the mark of their own colour where they have it,
        marks that are lit elsewhere, nothing where there are no marks.
        """
        agents, marks = self._view.agents, self._view.marks
        seeking = agents.there & (agents.colour >= 0)
        if not marks.there.any():
            return "", [""] * len(marks.there)
        if seeking.any():
            own = (agents.colour[:, :, None] == marks.colour[:, None]) & marks.there[:, None]
            offsets = agents.positions[:, :, None] - marks.positions[:, None]
            found = seeking & (own & (np.linalg.norm(offsets, axis=-1) < marks.radius[:, None])).any(-1)
            said, of = f"{self._words.agent}s at their {self._words.mark}", seeking
        else:
            found, of = marks.lit & marks.there, marks.there
            said = f"{self._words.mark}s {self._words.lit}"
        return said, [f"{some} / {all_of_them}" for some, all_of_them in zip(found.sum(1), of.sum(1), strict=True)]

    def _px(self, length: int) -> int:
        return round(length * self._unit)

    def _columns(self) -> tuple[tuple[int, str], ...]:
        """Where the footer's numbers stand, and which side of them."""
        return (self._px(16), "lm"), (self._size // 2, "mm"), (self._size - self._px(16), "rm")

    def _lay_out(self, draw: ImageDraw.ImageDraw, title: str, note: str) -> None:
        """What no step changes: title, captions and legend."""
        px, small = self._px, typeface(self._px(11))
        title = " ".join(title.split())
        marks = int(self._view.marks.there.any(0).sum())
        if not title:
            title = _count(int(self._view.agents.there.any(0).sum()), self._words.agent)
            title += f", {_count(marks, self._words.mark)}" if marks else ""
        bold, room = typeface(px(14), True), self._size - px(44) - small.getlength(note)
        while bold.getlength(title) > room:
            title = title.rstrip("…")[:-1] + "…"
        draw.text((px(16), px(19)), title, INK, bold, "lm")
        draw.text((self._size - px(16), px(19)), note, FAINT, small, "rm")
        captions = ("step", self._counted, "return so far")
        for (x, anchor), caption in zip(self._columns(), captions, strict=True):
            draw.text((x, self._footer + px(17)), caption, FAINT, small, anchor)

        kinds = {"agent": self._words.agent}
        kinds |= {"mark": self._words.mark, "lit": self._words.lit} if marks else {}
        kinds |= {} if self.episode.adjacency is None else {"edge": "can hear"}
        kinds |= {} if self._symbols is None or (self._symbols < 0).all() else {"message": "message"}
        words = list(kinds.values())
        icon = px(20)
        widths = [icon + px(5) + small.getlength(word) for word in words]
        gap = min(px(30), (self._size - px(24) - sum(widths)) / len(words))
        x, y = (self._size - sum(widths) - gap * (len(words) - 1)) / 2, self._footer + px(75)
        draw.line((px(16), y - px(18), self._size - px(16), y - px(18)), BORDER, max(1, px(1)))
        for (kind, word), width in zip(kinds.items(), widths, strict=True):
            self._page.paste(self._specimen(kind, icon), (round(x), y - icon // 2))
            draw.text((x + icon + px(5), y), word, INK, small, "lm")
            x += width + gap

    def _specimen(self, kind: str, size: int) -> Image.Image:
        """What the legend shows beside a word."""
        side = float(size * SUPERSAMPLING)
        image = Image.new("RGB", (round(side), round(side)), PAPER)
        pen, middle = Pen(image, self._unit), (side / 2, side / 2)
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
        return image.reduce(SUPERSAMPLING)

    def _scene(self, t: int) -> Image.Image:
        image = self._ground.copy()
        pen, agents, marks = Pen(image, self._unit), self._view.agents, self._view.marks
        discs: list[Point] = [(x, y) for x, y in self._discs[t].tolist()]
        rings: list[Point] = [(x, y) for x, y in self._rings[t].tolist()]
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
        return image.reduce(SUPERSAMPLING)

    def _now(self, t: int) -> int:
        """The step whose words and graph are shown: nothing is said after the end, the last words stay."""
        return min(t, self.episode.num_steps - 1)

    def _trail(self, t: int, agent: int) -> list[list[float]]:
        """Where an agent came from, as far as it has been there all the time."""
        there = self._view.agents.there[max(0, t - TRAIL_STEPS) : t + 1, agent]
        since = len(there) - 1 - int(np.argmin(there[::-1])) + 1 if not there.all() else 0
        return self._discs[max(0, t - TRAIL_STEPS) + since : t + 1, agent].tolist()

    def _edges(self, pen: "Pen", t: int, discs: Sequence[Point], sizes: Sequence[float]) -> None:
        """Who hears whom."""
        if self.episode.adjacency is None:
            return
        there = self._view.agents.there[t]
        hears = self.episode.adjacency[self._now(t)] & there[:, None] & there[None, :]
        strength = max(50, min(120, 4000 // max(int(hears.sum()), 1)))
        for i, j in np.argwhere(hears).tolist():
            if i < j or not hears[j, i]:
                pen.edge(discs[j], discs[i], strength, None if hears[j, i] else sizes[i])


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"
