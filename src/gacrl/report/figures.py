"""Figures over seeds, as the text of SVG files: curves, dots, performance profiles and grids.

The same numbers give the same bytes: no dates, fixed ids. Colours are Okabe and Ito's (2008), which the
colour-blind tell apart; lines differ in their dashes, and dots in their shapes, besides. A legend stands outside
the data.
"""

import io
from collections.abc import Generator, Iterable, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, TypeAlias

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000")
_DASHES = ("-", "--", "-.", ":")
_SHAPES = ("o", "s", "^", "D", "v", "P", "X")

Numbers: TypeAlias = ArrayLike | Sequence[Any]
Series: TypeAlias = tuple[Numbers, Numbers, Numbers | None, Numbers | None, Numbers | None]
"""x [P], the line [P], its interval's bounds [P] (None: no interval), each seed's line [S, P] (None: none)."""

_LOOK = {
    "svg.hashsalt": "gacrl",
    "svg.fonttype": "none",
    "font.size": 11,
    "axes.titlesize": 11,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e4e4e4",
    "legend.frameon": False,
    "figure.facecolor": "white",
}


def curves(
    series: Mapping[str, Series], xlabel: str, ylabel: str, lines: Mapping[str, float] | None = None
) -> str:
    """Lines with the band of their interval, and thin ones for seeds; SVG.

    lines: heights to mark by name, such as what random and oracle get.
    """
    with _figure(8.5, 4.5) as (figure, out):
        axes = figure.add_subplot()
        for k, (name, (x, point, low, high, seeds)) in enumerate(series.items()):
            color, dash, _ = _look(k)
            for seed in [] if seeds is None else np.atleast_2d(np.asarray(seeds, float)):
                axes.plot(x, seed, color=color, linewidth=0.7, alpha=0.35)
            if low is not None and high is not None:
                axes.fill_between(np.asarray(x, float), low, high, color=color, alpha=0.18, linewidth=0)
            axes.plot(x, point, dash, color=color, linewidth=2, label=name)
        for name, height in (lines or {}).items():
            axes.axhline(height, color="#555555", linewidth=1, linestyle=(0, (1, 2)))
            axes.annotate(
                _literal(name),
                (0, height),
                xycoords=("axes fraction", "data"),
                xytext=(3, 2),
                textcoords="offset points",
                color="#555555",
                fontsize=9,
            )
        _say(axes, xlabel, ylabel)
        _legend(axes)
    return out.getvalue()


def dots(
    values: Mapping[str, Numbers],
    estimates: Mapping[str, tuple[float, float, float] | None],
    xlabel: str,
    lines: Mapping[str, float] | None = None,
) -> str:
    """A row for each name: every seed [S] as a dot, and under them the estimate (point, low, high); SVG.

    A name without an estimate has its dots alone. lines: places to mark by name, such as random and oracle.
    """
    with _figure(8.5, 1.3 + 0.62 * max(len(values), 1)) as (figure, out):
        axes = figure.add_subplot()
        for row, (name, seeds) in enumerate(values.items()):
            color, _, shape = _look(row)
            scores = np.atleast_1d(np.asarray(seeds, float))
            axes.plot(scores, np.full(len(scores), row - 0.14), shape, color=color, alpha=0.6, markersize=6, mew=0)
            found = estimates.get(name)
            if found is not None:
                point, low, high = found
                axes.plot([low, high], [row + 0.16] * 2, color=color, linewidth=3, solid_capstyle="butt")
                axes.plot([point], [row + 0.16], "|", color=color, markersize=14, mew=3)
        for name, place in (lines or {}).items():
            axes.axvline(place, color="#555555", linewidth=1, linestyle=(0, (1, 2)))
            axes.annotate(
                _literal(name),
                (place, 1),
                xycoords=("data", "axes fraction"),
                xytext=(0, 3),
                textcoords="offset points",
                color="#555555",
                fontsize=9,
                ha="center",
            )
        axes.set_yticks(range(len(values)), _literals(values))
        axes.set_ylim(len(values) - 0.5, -0.5)
        axes.grid(visible=False, axis="y")
        _say(axes, xlabel, "")
    return out.getvalue()


def profile(
    profiles: Mapping[str, tuple[Numbers, Numbers, Numbers | None, Numbers | None]],
    xlabel: str,
    ylabel: str = "share of runs above",
) -> str:
    """Performance profiles: for each name thresholds [P], the share of runs above them [P] and its bounds; SVG."""
    with _figure(8.5, 4.2) as (figure, out):
        axes = figure.add_subplot()
        for k, (name, (thresholds, share, low, high)) in enumerate(profiles.items()):
            color, dash, _ = _look(k)
            if low is not None and high is not None:
                axes.fill_between(
                    np.asarray(thresholds, float), low, high, step="post", color=color, alpha=0.18, linewidth=0
                )
            axes.step(thresholds, share, dash, where="post", color=color, linewidth=2, label=name)
        axes.set_ylim(-0.03, 1.03)
        _say(axes, xlabel, ylabel)
        _legend(axes)
    return out.getvalue()


def heat(
    values: Numbers,
    panels: tuple[str, Sequence[str]],
    rows: tuple[str, Sequence[str]],
    columns: tuple[str, Sequence[str]],
    label: str,
) -> str:
    """A grid of results [panels, rows, columns]: panels side by side, a number in every cell; SVG.

    panels, rows, columns: an axis's title and the labels along it. label: what is measured. NaN: an empty cell.
    """
    grid = np.asarray(values, float)
    shape = (len(panels[1]), len(rows[1]), len(columns[1]))
    if grid.shape != shape:
        raise ValueError(f"a grid of shape {list(grid.shape)} has labels for {list(shape)}")
    finite = grid[np.isfinite(grid)]
    low, high = (finite.min(), finite.max()) if finite.size else (0.0, 1.0)
    with _figure(1.6 + 1.0 * shape[0] * (shape[2] + 0.4), 1.6 + 0.75 * shape[1]) as (figure, out):
        plots: list[Axes] = list(np.ravel(figure.subplots(1, shape[0], sharey=True, squeeze=False)))
        image = None
        for axes, name, panel in zip(plots, panels[1], grid, strict=True):
            image = axes.imshow(panel, cmap="cividis", vmin=low, vmax=high, aspect="auto")
            for (i, j), value in np.ndenumerate(panel):
                if np.isfinite(value):
                    dark = value < (low + high) / 2
                    color = "white" if dark else "black"
                    axes.text(j, i, f"{value:.3g}", ha="center", va="center", color=color, fontsize=10)
            axes.set_title(_literal(f"{panels[0]} {name}"))
            axes.set_xticks(range(shape[2]), _literals(columns[1]))
            axes.set_yticks(range(shape[1]), _literals(rows[1]))
            axes.grid(visible=False)
            _say(axes, columns[0], rows[0] if axes is plots[0] else "")
        if image is not None:
            figure.colorbar(image, ax=plots, label=_literal(label))
    return out.getvalue()


@contextmanager
def _figure(width: float, height: float) -> Generator[tuple[Figure, io.StringIO]]:
    """An empty figure of that size in inches, and the text that it becomes when it is done."""
    out = io.StringIO()
    look: dict[Any, Any] = {name: value for name, value in mpl.rcParamsDefault.items() if name != "backend"}
    look.update(_LOOK)
    with mpl.rc_context(look):
        figure = Figure(figsize=(width, height), layout="constrained")
        yield figure, out
        drawn = io.StringIO()
        metadata: dict[str, Any] = {"Date": None, "Creator": None, "Format": None, "Type": None}
        FigureCanvasSVG(figure).print_svg(drawn, metadata=metadata)
    text = drawn.getvalue()
    out.write("\n".join(line.rstrip() for line in text[text.index("<svg") :].splitlines()) + "\n")


def _look(k: int) -> tuple[str, str, str]:
    """Colour, dash and shape of the k-th thing: the combinations go round after 28."""
    color = PALETTE[k % len(PALETTE)]
    return color, _DASHES[(k + k // len(PALETTE)) % len(_DASHES)], _SHAPES[(k + k // len(PALETTE)) % len(_SHAPES)]


def _say(axes: Axes, xlabel: str, ylabel: str) -> None:
    axes.set_xlabel(_literal(xlabel))
    axes.set_ylabel(_literal(ylabel))


def _legend(axes: Axes) -> None:
    handles, names = axes.get_legend_handles_labels()
    if handles:
        axes.legend(handles, _literals(names), loc="upper left", bbox_to_anchor=(1.01, 1.0))


def _literals(texts: Iterable[str]) -> list[str]:
    return [_literal(text) for text in texts]


def _literal(text: str) -> str:
    """Text that matplotlib shows as it is: two dollars would make it a formula."""
    return text.replace("$", r"\$")
