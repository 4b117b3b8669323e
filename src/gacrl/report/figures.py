"""Figures over seeds, as the text of SVG files: curves, dots, performance profiles and grids.

The same numbers give the same bytes: no dates, fixed ids. An algorithm has one colour in all figures, of those that the
colour-blind tell apart (Okabe and Ito 2008, then Tol's); lines differ in dash and marker besides, and are labelled
where they end.
"""

import io
from collections.abc import Collection, Generator, Iterable, Mapping, Sequence
from contextlib import contextmanager
from types import MappingProxyType
from typing import Any, NamedTuple, TypeAlias

import matplotlib as mpl
import numpy as np
from matplotlib import colors
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, StrMethodFormatter
from numpy.typing import ArrayLike, NDArray

from gacrl.report.figures_labels import Label, above, beside, folded, literal

COLORS: Mapping[str, str] = MappingProxyType(
    {
        "gacrl": "#0072B2",
        "mappo": "#D55E00",
        "qmix": "#009E73",
        "vdn": "#CC79A7",
        "ippo": "#56B4E9",
        "gacrl_paper": "#E69F00",
        "iql": "#882255",
        "commnet": "#117733",
        "dial": "#000000",
        "random": "#666666",
        "noop": "#999999",
    }
)
"""Of algorithms, and of policies that learn nothing, by name."""
PALETTE = (*list(COLORS.values())[:9], "#332288", "#999933", "#661100", "#44AA99")
"""What others take, in order, as far as it is free in their figure."""
_DASHES: tuple[Any, ...] = (
    *("-", "--", "-.", ":", (0, (8, 2)), (0, (5, 1, 1, 1, 1, 1)), (0, (3, 1)), (0, (1, 1)), (0, (9, 2, 3, 2))),
)
_SHADES = (0.0, -0.4, 0.4, -0.6, 0.6)
"""How far a colour is mixed with white, or below 0 with black, from one name of the same kind to the next."""
_SHAPES = ("o", "s", "^", "D", "v", "P", "X", "<", ">")
_REFERENCE: Mapping[str, Any] = MappingProxyType({"color": "#555555", "linestyle": (0, (1, 2))})
_WIDTH = 6.5
"""Inches: as wide as the text of a page. In a column of half that width the words are still legible."""
_MARKED = 12
"""Evaluations of a curve up to which each has a marker; of a longer one the last."""

Numbers: TypeAlias = ArrayLike | Sequence[Any]
Series: TypeAlias = tuple[Numbers, Numbers, Numbers | None, Numbers | None, Numbers | None]
"""x [P], the line [P], its interval's bounds [P] (None, or NaN: no interval), each seed's line [S, P] (None: none), NaN
behind its end."""

_LOOK = {
    "svg.hashsalt": "gacrl",
    "svg.fonttype": "none",
    "font.size": 10,
    "axes.titlesize": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e4e4e4",
    "figure.facecolor": "white",
}


class Look(NamedTuple):
    """How a line and its points are drawn."""

    color: str
    dash: Any
    shape: str


def looks(names: Sequence[str], kinds: Mapping[str, str] | None = None) -> dict[str, Look]:
    """Return a look for each name, no two alike: a shade of its kind's colour; dash and marker go on from name to name.

    kinds: the algorithm of each name; without: its name in small letters. Where all are of one kind, colours tell the
    names apart, and the first keeps the kind's.
    """
    kind = {name: (kinds or {}).get(name, name).lower() for name in names}
    if len(set(kind.values())) == 1 and len(names) > 1:
        kind = {name: kind[name] if name == names[0] else f"{kind[name]} {name}" for name in names}
    taken = {COLORS[k] for k in kind.values() if k in COLORS}
    free = [color for color in PALETTE if color not in taken] or list(PALETTE)
    others = list(dict.fromkeys(k for k in kind.values() if k not in COLORS))
    color = {**COLORS, **{k: free[n % len(free)] for n, k in enumerate(others)}}
    found: dict[str, Look] = {}
    for n, name in enumerate(names):
        before = [color[kind[other]] for other in names[:n]].count(color[kind[name]])
        shade = _shaded(color[kind[name]], _SHADES[before % len(_SHADES)])
        used = [look.dash for look in found.values() if look.color == shade]
        turned = [_DASHES[(n + k) % len(_DASHES)] for k in range(len(_DASHES))]
        dash = next((dash for dash in turned if dash not in used), turned[0])
        found[name] = Look(shade, dash, _SHAPES[(n + n // len(_SHAPES)) % len(_SHAPES)])
    return found


def _shaded(color: str, share: float) -> str:
    """The colour mixed with white, or with black where the share is below 0."""
    target = 1.0 if share > 0 else 0.0
    red, green, blue = ((1 - abs(share)) * part + abs(share) * target for part in colors.to_rgb(color))
    return colors.to_hex((red, green, blue)).upper()


def curves(
    series: Mapping[str, Series],
    xlabel: str,
    ylabel: str,
    lines: Mapping[str, float] | None = None,
    styles: Mapping[str, Look] | None = None,
    stopped: Collection[str] = (),
    begin: float | None = None,
) -> str:
    """Draw lines with the band of their interval, thin ones for seeds, and a label where each line ends; SVG.

    A cross marks where a seed ends before others of its line, and where a line ends that is in `stopped`. lines:
    heights to mark by name, such as what random and oracle get. styles: from `looks`; none: made for these names.
    begin: where the x axis begins; none: at the first number.
    """
    styles = styles or looks(list(series))
    count = len(series) + len(lines or {})
    with _figure(_WIDTH, max(3.6, 0.9 + 0.19 * count)) as (figure, out):
        axes = figure.add_subplot()
        for name, one in series.items():
            _curve(axes, one, styles[name], len(series), name in stopped)
        for height in (lines or {}).values():
            axes.axhline(height, linewidth=1, **_REFERENCE)
        if begin is not None:
            axes.set_xlim(left=begin)
        axes.xaxis.set_major_locator(MaxNLocator(5))
        if axes.get_xlim()[1] >= 1000:
            axes.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
        _say(axes, xlabel, ylabel)
        right = max((np.max(np.asarray(one[0], float), initial=-np.inf) for one in series.values()), default=0.0)
        beside(axes, [*_ends(series, styles, right), *_references(lines)])
    return out.getvalue()


def _curve(axes: Axes, series: Series, look: Look, count: int, stopped: bool) -> None:
    x, point = np.asarray(series[0], float), np.asarray(series[1], float)
    low, high, seeds = (None if part is None else np.asarray(part, float) for part in series[2:])
    alone = len(x) == 1
    marker: dict[str, Any] = {
        "marker": look.shape,
        "markersize": 5,
        "markevery": 1 if len(x) <= _MARKED else [len(x) - 1],
    }
    for seed in [] if seeds is None else np.atleast_2d(seeds):
        thin: dict[str, Any] = {"marker": ".", "markersize": 4} if np.isfinite(seed).sum() == 1 else {}
        axes.plot(x, seed, color=look.color, linewidth=0.6, alpha=0.35, **thin)
    if low is not None and high is not None:
        lonely = _isolated(np.isfinite(low))
        if not lonely.all():
            axes.fill_between(x, low, high, color=look.color, alpha=_alpha(count), linewidth=0)
        axes.vlines(x[lonely], low[lonely], high[lonely], color=look.color, linewidth=2, alpha=0.5)
    axes.plot(x, point, linestyle=look.dash, color=look.color, linewidth=0 if alone else 2, **marker)
    ends = _drop_outs(seeds) | ({len(x) - 1} if stopped and len(x) else set())
    at = sorted(ends)
    axes.plot(x[at], point[at], "x", color=look.color, markersize=9, mew=2)


def _isolated(there: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Those without a neighbour: a band has no width there [P]."""
    padded = np.concatenate([[False], there, [False]])
    return there & ~padded[:-2] & ~padded[2:]


def _drop_outs(seeds: NDArray[np.float64] | None) -> set[int]:
    """The last evaluations before one that fewer seeds have."""
    if seeds is None:
        return set()
    many = np.isfinite(np.atleast_2d(seeds)).sum(0)
    return {int(k) for k in np.flatnonzero(np.diff(many) < 0)}


def _ends(series: Mapping[str, Series], styles: Mapping[str, Look], right: float) -> list[Label]:
    """A label for each line, at the height of its last point."""
    return [
        Label(name, float(np.asarray(point)[-1]), _style(styles[name]), float(np.asarray(x)[-1]) == right)
        for name, (x, point, *_) in series.items()
        if len(np.asarray(point))
    ]


def _references(lines: Mapping[str, float] | None) -> list[Label]:
    return [Label(name, height, dict(_REFERENCE)) for name, height in (lines or {}).items()]


def _style(look: Look) -> dict[str, Any]:
    return {"color": look.color, "linestyle": look.dash, "marker": look.shape}


def dots(
    values: Mapping[str, Numbers],
    estimates: Mapping[str, tuple[float, float, float] | None],
    xlabel: str,
    lines: Mapping[str, float] | None = None,
    styles: Mapping[str, Look] | None = None,
) -> str:
    """Draw a row for each name: every seed [S] as a dot, and under them the estimate (point, low, high); SVG.

    A name without an estimate has its dots alone, one without seeds the word "diverged". lines: places to mark by name,
    such as random and oracle. styles: from `looks`.
    """
    styles = styles or looks(list(values))
    with _figure(_WIDTH, 1.3 + 0.5 * max(len(values), 1)) as (figure, out):
        axes = figure.add_subplot()
        for row, (name, seeds) in enumerate(values.items()):
            color, _, shape = styles[name]
            scores = np.atleast_1d(np.asarray(seeds, float))
            axes.plot(scores, np.full(len(scores), row - 0.14), shape, color=color, alpha=0.6, markersize=6, mew=0)
            found = estimates.get(name)
            if found is not None:
                point, low, high = found
                axes.plot([low, high], [row + 0.16] * 2, color=color, linewidth=3, solid_capstyle="butt")
                axes.plot([point], [row + 0.16], "|", color=color, markersize=12, mew=3)
            if not len(scores):
                over: dict[str, Any] = {
                    "bbox": {"facecolor": "white", "edgecolor": "none", "pad": 1},
                    "fontsize": 9,
                    "va": "center",
                }
                axes.annotate("diverged", (0.01, row), xycoords=("axes fraction", "data"), **over)
        for place in (lines or {}).values():
            axes.axvline(place, linewidth=1, **_REFERENCE)
        axes.set_yticks(range(len(values)), [folded(name) for name in values])
        axes.set_ylim(len(values) - 0.5, -0.5)
        axes.grid(visible=False, axis="y")
        _say(axes, xlabel, "")
        above(axes, dict(lines or {}), _REFERENCE["color"])
    return out.getvalue()


def profile(
    profiles: Mapping[str, tuple[Numbers, Numbers, Numbers | None, Numbers | None]],
    xlabel: str,
    styles: Mapping[str, Look] | None = None,
) -> str:
    """Draw performance profiles: for each name thresholds [P], the share of runs above them [P] and its bounds; SVG.

    The labels beside it are in the order of the mean share. styles: from `looks`.
    """
    styles = styles or looks(list(profiles))
    with _figure(_WIDTH, max(3.4, 0.9 + 0.19 * len(profiles))) as (figure, out):
        axes = figure.add_subplot()
        for name, (thresholds, share, low, high) in profiles.items():
            color, dash, _ = styles[name]
            x = np.asarray(thresholds, float)
            if low is not None and high is not None:
                band: dict[str, Any] = {
                    "step": "post",
                    "color": color,
                    "alpha": _alpha(len(profiles)),
                    "linewidth": 0,
                }
                axes.fill_between(x, np.asarray(low, float), np.asarray(high, float), **band)
            axes.step(x, share, linestyle=dash, where="post", color=color, linewidth=2)
        axes.set_ylim(-0.03, 1.03)
        _say(axes, xlabel, "share of seeds above")
        means = {name: float(np.mean(np.asarray(share))) for name, (_, share, _, _) in profiles.items()}
        beside(axes, [Label(name, means[name], {**_style(styles[name]), "marker": None}, False) for name in means])
    return out.getvalue()


def paths(
    walks: Mapping[str, Sequence[tuple[Numbers, Numbers]]],
    xlabel: str,
    ylabel: str,
    styles: Mapping[str, Look] | None = None,
) -> str:
    """Draw for each name the way of each seed through a plane, x [P] and y [P], to a marker where it ends; SVG.

    styles: from `looks`.
    """
    styles = styles or looks(list(walks))
    with _figure(_WIDTH, max(3.6, 0.9 + 0.19 * len(walks))) as (figure, out):
        axes = figure.add_subplot()
        labels: list[Label] = []
        for name, seeds in walks.items():
            color, dash, shape = styles[name]
            for x, y in seeds:
                axes.plot(x, y, linestyle=dash, color=color, linewidth=0.8, alpha=0.5)
                axes.plot(np.asarray(x)[-1:], np.asarray(y)[-1:], shape, color=color, markersize=5)
            height = float(np.mean([np.asarray(y, float)[-1] for _, y in seeds]))
            labels.append(Label(name, height, _style(styles[name]), False))
        _say(axes, xlabel, ylabel)
        beside(axes, labels)
    return out.getvalue()


def heat(
    values: Numbers,
    panels: tuple[str, Sequence[str]],
    rows: tuple[str, Sequence[str]],
    columns: tuple[str, Sequence[str]],
    label: str,
) -> str:
    """Draw a grid of results [panels, rows, columns]: panels side by side, a number in every cell; SVG.

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
                    written = value if abs(value) > 1e-9 * (high - low) else 0.0  # what rounding leaves of nothing
                    axes.text(j, i, f"{written:.3g}", ha="center", va="center", color=color, fontsize=10)
            axes.set_title(literal(f"{panels[0]} {name}"))
            axes.set_xticks(range(shape[2]), _literals(columns[1]))
            axes.set_yticks(range(shape[1]), _literals(rows[1]))
            axes.grid(visible=False)
            _say(axes, columns[0], rows[0] if axes is plots[0] else "")
        if image is not None:
            figure.colorbar(image, ax=plots, label=literal(label))
    return out.getvalue()


@contextmanager
def _figure(width: float, height: float) -> Generator[tuple[Figure, io.StringIO]]:
    """An empty figure of that size in inches, and the text that it becomes when it is done."""
    out = io.StringIO()
    look: dict[Any, Any] = {name: value for name, value in mpl.rcParamsDefault.items() if name != "backend"}
    look.update(_LOOK)
    with mpl.rc_context(look):
        figure = Figure(figsize=(width, height), dpi=72, layout="constrained")  # as SVG has it
        yield figure, out
        drawn = io.StringIO()
        metadata: dict[str, Any] = {"Date": None, "Creator": None, "Format": None, "Type": None}
        FigureCanvasSVG(figure).print_svg(drawn, metadata=metadata)
    text = drawn.getvalue()
    out.write("\n".join(line.rstrip() for line in text[text.index("<svg") :].splitlines()) + "\n")


def _alpha(count: int) -> float:
    """How dense a band is: many lie on each other."""
    return 0.2 if count <= 3 else 0.1 if count <= 6 else 0.06


def _say(axes: Axes, xlabel: str, ylabel: str) -> None:
    axes.set_xlabel(literal(xlabel))
    axes.set_ylabel(literal(ylabel))


def _literals(texts: Iterable[str]) -> list[str]:
    return [literal(text) for text in texts]
