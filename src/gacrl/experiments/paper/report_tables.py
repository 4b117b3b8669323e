"""The paper's tables and figures, theirs and ours, as sections of a page."""

import io
from collections.abc import Mapping, Sequence
from itertools import chain
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from gacrl.config import files as configuration
from gacrl.evaluation.evaluate import stream_key
from gacrl.evaluation.statistics import sample_efficiency, with_interval
from gacrl.experiments.paper import tables as paper_tables
from gacrl.experiments.paper.claims import Judged, Reading, claims, measures
from gacrl.experiments.paper.evidence import COLUMNS, FINAL_EPISODES, Evidence, measured
from gacrl.experiments.paper.spans import best_of_random, random_interval
from gacrl.experiments.paper.spans import inside as is_inside
from gacrl.experiments.paper.tables import SCRIPTED
from gacrl.report import figures
from gacrl.report.page import Page
from gacrl.tasks.spread.environment import Spread


def table_1(page: Page, evidence: Evidence) -> None:
    page.heading("Table I: hyperparameters")
    data = configuration.to_dict(evidence.series["paper", "GACRL"].config)
    rows: list[list[str]] = []
    for entry in paper_tables.printed()["table_1"]["rows"]:
        ours = [_setting(data, name) for name in entry["setting"]]
        rows.append([entry["name"], _values(entry["printed"]), _values(ours), ", ".join(entry["setting"])])
    page.table(("parameter", "paper", "ours", "setting"), rows)
    page.text(
        "The networks have one hidden layer more than Table I names, without which the printed shapes do not fit "
        "each other. The paper prints no settings of the baselines; ours are at the end."
    )


def environment(page: Page) -> None:
    page.heading("Figure 1: the environment")
    page.figure(
        environment_svg(),
        "Three agents (discs of their true size) and three landmarks (stars, the threshold θ = 0.5 around them).",
        "environment",
    )


def training_figures(page: Page, evidence: Evidence) -> None:
    page.heading("Figures 2 to 4: training")
    page.text(
        f"The mean of each stretch of about {FINAL_EPISODES} episodes: IQM over the seeds with its 95 % interval, "
        f"and each seed. Random's band holds 95 % of the means of {FINAL_EPISODES} episodes at the difficulty of the "
        "moment. The paper shows GACRL alone; the curves of the baselines and the distance between agents are "
        "added."
    )
    shown = (
        ("shaped", "Figure 2: shaped reward"),
        ("coverage_theta", "Figure 3: landmarks covered, within θ of the moment"),
        ("coverage_0.1", "Figure 3 again: landmarks covered, within 0.1"),
        ("distance", "Figure 4: distance to the nearest landmark"),
        ("agents", "Not in the paper: distance between agents"),
    )
    for name, title in shown:
        for column in ("paper", "mpe2"):
            scripted = {who: _scripted_curve(evidence, column, who, name) for who in ("random", "noop")}
            names = tuple(who for at, who in evidence.series if at == column)
            everyone = {who: _curve(evidence, column, who, name, seeds=False) for who in names}
            if column == "paper":
                page.figure(
                    figures.curves(
                        {"GACRL": _curve(evidence, column, "GACRL", name)} | scripted,
                        "episode",
                        measures()[name].label,
                    ),
                    f"{title}. GACRL trained on {COLUMNS[column]}.",
                    _file("gacrl", column, name),
                )
            page.figure(
                figures.curves(everyone | {"random": scripted["random"]}, "episode", measures()[name].label),
                f"{title}, all that trained on {COLUMNS[column]}.",
                _file("all", column, name),
            )


def _curve(evidence: Evidence, column: str, who: str, name: str, seeds: bool = True) -> Any:
    series = evidence.series[column, who]
    values = measured(measures()[name].weights, series.mean)
    curve = sample_efficiency(values)
    return series.episodes, curve.point, curve.low, curve.high, values if seeds else None


def _scripted_curve(evidence: Evidence, column: str, who: str, name: str) -> Any:
    weights = measures()[name].weights
    played = [measured(weights, metrics) for metrics in evidence.references[column, who].stretches]
    low, high = np.array([random_interval(episodes, FINAL_EPISODES) for episodes in played]).T
    episodes = next(series.episodes for (at, _), series in evidence.series.items() if at == column)
    return episodes, np.array([e.mean() for e in played]), low, high, None


def table_2(page: Page, evidence: Evidence) -> None:
    table = paper_tables.printed()["table_2"]
    page.heading(table["caption"])
    series = evidence.series["paper", "GACRL"]
    chosen = ("shaped", "raw", "coverage_theta", "coverage_0.1", "distance", "near")
    rows: list[list[str]] = []
    for episode, numbers in table["rows"].items():
        found = np.flatnonzero(series.episodes == int(episode))
        printed = dict(zip(table["columns"], numbers, strict=True))
        rows.append([episode, "paper", *(f"{printed[measures()[name].printed]:g}" for name in chosen)])
        if not len(found):
            rows.append([episode, "not logged by these runs", *[""] * len(chosen)])
            continue
        k = int(found[0])
        for title, metrics in (("this episode", series.last), (f"mean of {FINAL_EPISODES}", series.mean)):
            seen = [measured(measures()[name].weights, metrics)[:, k] for name in chosen]
            rows.append(
                [
                    episode,
                    f"ours, {title}: mean (least to most of the seeds)",
                    *(_with_range(values) for values in seen),
                ]
            )
        for who in SCRIPTED:
            played = evidence.references["paper", who].stretches[k]
            seen = [measured(measures()[name].weights, played) for name in chosen]
            rows.append([episode, f"{who}: mean, 95 % of its episodes", *(_with_span(values) for values in seen)])
    page.table(("episode", "who", *(measures()[name].label for name in chosen)), rows)
    page.text(
        "A row is read as one episode: the printed row of episode 1500 is not the mean of the last 50 of Table III."
        " Landmark coverage stands here twice, and the printed number beside both: no single radius fits both "
        "tables."
    )


def printed_numbers(page: Page, evidence: Evidence, judged: Sequence[Judged]) -> None:
    """Write the means of Table III beside random, doing nothing and the oracle."""
    page.heading("What the printed numbers say")
    by_label = {measure.label: measure for measure in measures().values()}
    inside = beaten = 0
    rows: list[list[str]] = []
    for cell in chain(*(j.base.numbers.get("cells", ()) for j in judged if "row_of" in j.claim.settings)):
        measure, printed = by_label[cell["measure"]], cell["printed"]
        random, noop, oracle = (
            measured(measure.weights, evidence.references["paper", who].stretches[-1]).mean() for who in SCRIPTED
        )
        within = is_inside(printed, cell["random"])
        ahead = measure.sign * (float(noop) - printed) > 0
        inside, beaten = inside + within, beaten + ahead
        rows.append(
            [
                measure.label,
                cell["who"],
                f"{printed:g}",
                with_interval((float(random), *cell["random"]), ".3g"),
                "inside" if within else "outside",
                f"{noop:.3g}, {'better' if ahead else 'not better'}",
                f"{oracle:.3g}",
            ]
        )
    page.table(
        (
            "column",
            "who",
            "printed",
            f"random, means of {FINAL_EPISODES}: 95 % for all cells at once",
            "",
            "doing nothing",
            "oracle",
        ),
        rows,
    )
    best = {
        name: best_of_random(measures()[name], Reading(), evidence)
        for name in ("shaped", "distance", "coverage_theta")
    }
    lines = len(evidence.references["paper", "random"].stretches)
    page.text(
        f"{inside} of the {len(rows)} printed means of Table III lie where random's means of {FINAL_EPISODES} episodes "
        f"lie; doing nothing is better than {beaten} of them. The best of {lines} logged episodes of random lies, with "
        "95 %, "
        + "; ".join(f"within [{low:.3g}, {high:.3g}] for {measures()[n].label}" for n, (low, high) in best.items())
        + f"; the text cites {', '.join(f'{peak:g}' for peak in _printed_peaks())}. All of this at the difficulty "
        "of the paper's curriculum."
    )


def _printed_peaks() -> list[float]:
    return [claim.settings["printed"] for claim in claims() if claim.kind == "peak"]


def environment_svg() -> str:
    """Return the paper's Figure 1: a start of the environment, as SVG."""
    import matplotlib
    from matplotlib.figure import Figure
    from matplotlib.patches import Circle

    state, _ = Spread().reset(stream_key("report"))
    agents, landmarks = jax.device_get((state.positions, state.landmarks))
    figure = Figure(figsize=(4.2, 4.2))
    axes = figure.add_subplot(aspect="equal", xlim=(-1.25, 1.25), ylim=(-1.25, 1.25))
    for k, place in enumerate(landmarks, 1):
        axes.add_patch(Circle(place, 0.5, fill=False, linestyle=":", edgecolor="#b03030"))
        axes.plot(*place, marker="*", markersize=14, color="#b03030")
        axes.annotate(f"Landmark {k}", place, (6, 8), textcoords="offset points", fontsize=8)
    for k, place in enumerate(agents, 1):
        axes.add_patch(Circle(place, 0.15, color="#3060a8", alpha=0.85))
        axes.annotate(f"Agent {k}", place, (-16, -18), textcoords="offset points", fontsize=8)
    file = io.StringIO()
    with matplotlib.rc_context({"svg.hashsalt": "gacrl", "svg.fonttype": "none"}):
        figure.savefig(file, format="svg", metadata={"Date": None})
    return file.getvalue()


def _setting(data: Mapping[str, Any], dotted: str) -> Any:
    section, name = dotted.split(".")
    return data[section][name]


def _values(values: Sequence[Any]) -> str:
    flat = [inner for value in values for inner in (value if isinstance(value, list | tuple) else [value])]
    return ", ".join(f"{value:g}" for value in flat)


def _with_range(values: Float[np.ndarray, " S"]) -> str:
    return f"{values.mean():.3g} ({values.min():.3g} to {values.max():.3g})"


def _with_span(episodes: Float[np.ndarray, " E"]) -> str:
    low, high = np.percentile(episodes, [2.5, 97.5])
    return with_interval((float(episodes.mean()), float(low), float(high)), ".3g")


def _file(*words: str) -> str:
    return "-".join(word.replace(".", "") for word in words)
