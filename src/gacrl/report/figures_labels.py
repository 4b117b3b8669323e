"""Labels of lines beside the figure, and of references above it, so that none lies on another."""

import textwrap
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.text import Annotation
from numpy.typing import NDArray

_CONNECTOR, _SAMPLE, _GAP = 9.0, 20.0, 4.0
"""Points that a label's connector, sample of its line and distance to the words take."""
_FOLDED = 28
"""Letters of a label in a line."""
_SIZE = 9
_INK = "#222222"


class Label(NamedTuple):
    """What a line is called, and how it looks."""

    text: str
    height: float
    """Where the line ends, in data."""
    style: dict[str, Any]
    """Of the sample: `color`, `linestyle`, `marker`."""
    connected: bool = True
    """Whether the line ends at the right edge, from which a connector leads to the words."""


def literal(text: str) -> str:
    """Return text that matplotlib shows as it is: two dollars would make it a formula."""
    return text.replace("$", r"\$")


def folded(text: str) -> str:
    """Return the same on lines of _FOLDED letters at most."""
    return literal("\n".join(textwrap.wrap(text, _FOLDED, break_on_hyphens=False)) or text)


def beside(axes: Axes, labels: Sequence[Label]) -> None:
    """Write the labels to the right of the axes, each at the height of its line or as near as there is room.

    To be called when all else is drawn: it lays out the figure, and fixes its layout.
    """
    offset = _CONNECTOR + _SAMPLE + _GAP
    texts = [
        axes.annotate(
            folded(label.text),
            (1.0, label.height),
            xycoords=("axes fraction", "data"),
            xytext=(offset, 0.0),
            textcoords="offset points",
            annotation_clip=False,
            color=_INK,
            fontsize=_SIZE,
            va="center",
        )
        for label in labels
    ]
    figure = _figure_of(axes)
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    box, point = axes.get_window_extent(), figure.dpi / 72
    ends = axes.transData.transform([(0.0, label.height) for label in labels])[:, 1] if labels else np.zeros(0)
    tall = np.array([text.get_window_extent().height for text in texts]) + 2 * point
    for label, text, end, middle in zip(labels, texts, ends, spread(ends, tall, box.y0, box.y1), strict=True):
        text.set_position((offset, (middle - end) / point))
        starts = box.x1 + _CONNECTOR * point
        sample = [starts, starts + _SAMPLE * point / 2, starts + _SAMPLE * point]
        look: dict[str, Any] = {
            "clip_on": False,
            "transform": None,
            "linewidth": 2,
            "markersize": 5,
            **label.style,
        }
        figure.add_artist(Line2D(sample, [middle] * 3, markevery=[1], **look))
        if label.connected:
            thin: dict[str, Any] = {**look, "linewidth": 0.7, "linestyle": "-", "marker": None}
            figure.add_artist(Line2D([box.x1, starts - point], [end, middle], **thin))


def _figure_of(axes: Axes) -> Figure:
    figure = axes.get_figure(root=True)
    assert figure is not None
    return figure


def spread(wanted: Sequence[float] | NDArray[Any], tall: NDArray[Any], low: float, high: float) -> NDArray[Any]:
    """Return the middles [K] of K labels on a line: none on another, all between low and high where there is room.

    wanted: their middles as they should be. tall: their heights. Neighbours that would meet are moved as one block.
    """
    order = np.argsort(wanted, kind="stable")
    blocks: list[tuple[list[int], float, float]] = []  # labels from low to high, middle of all, height of all
    for k in order:
        block = ([int(k)], float(wanted[k]), float(tall[k]))
        while True:
            middle = min(max(block[1], low + block[2] / 2), max(high - block[2] / 2, low + block[2] / 2))
            block = (block[0], middle, block[2])
            if not blocks or blocks[-1][1] + blocks[-1][2] / 2 <= block[1] - block[2] / 2:
                break
            before = blocks.pop()
            members = before[0] + block[0]
            block = (members, float(np.mean([wanted[m] for m in members])), before[2] + block[2])
        blocks.append(block)
    found = np.zeros(len(order))
    for members, middle, height in blocks:
        edge = middle - height / 2
        for k in members:
            found[k] = edge + tall[k] / 2
            edge += tall[k]
    return found


def above(axes: Axes, places: dict[str, float], color: str) -> None:
    """Write names above the axes at places along it, one line higher where they would lie on another."""
    texts: list[Annotation] = []
    for name, place in sorted(places.items(), key=lambda item: item[1]):
        text = axes.annotate(
            literal(name),
            (place, 1.0),
            xycoords=("data", "axes fraction"),
            xytext=(0.0, 3.0),
            textcoords="offset points",
            annotation_clip=False,
            color=color,
            fontsize=_SIZE,
            ha="center",
        )
        texts.append(text)
    _figure_of(axes).draw_without_rendering()
    ends: list[float] = []  # how far each line of names is filled
    for text in texts:
        box = text.get_window_extent()
        level = next((k for k, end in enumerate(ends) if end < box.x0 - 4), len(ends))
        ends[level:] = [box.x1, *ends[level + 1 :]]
        text.set_position((0.0, 3.0 + level * (_SIZE + 3)))
