"""What the site shows of files and of the package: scores, studies, settings, docstrings."""

import json
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any

from sphinx.pycode import ModuleAnalyzer

import gacrl
from gacrl import tasks
from gacrl.evaluation.statistics import estimate
from gacrl.report.page import markdown_table

COLUMNS = 3
"""Metrics in a table of scores: the first ones of the task's own tables."""
DOCS = Path(__file__).resolve().parent.parent


def number(value: float) -> str:
    """Return a number with three digits that count, and the sign that the documents have."""
    shown = f"{value:.2f}" if abs(value) >= 0.995 else f"{value:.3f}"
    return shown.replace("-", "−")


def scores(task: str, files: list[str]) -> str:
    """Return what is known of a task: policies that learn nothing, then a row for each file of docs/data."""
    known, record = tasks.find(task).known(), tasks.find(task)
    kept = {
        who: known.get("scripted", {}).get(who, {record.headline: score}) for who, score in known["scores"].items()
    }
    summaries = {file: json.loads((DOCS / "data" / f"{file}.json").read_text(encoding="utf-8")) for file in files}
    measured = [summary["final"]["greedy"] for summary in summaries.values()]
    shown = dict(list(record.shown(list((measured or [kept["random"]])[0])).items())[:COLUMNS])
    rows = [
        [who, "", *(number(of[name]) if name in of else "" for name in shown), _command(known, who)]
        for who, of in kept.items()
    ]
    for (file, summary), final in zip(summaries.items(), measured, strict=True):
        cells = [_estimated(final[name]["values"]) for name in shown]
        made = f"`{summary['command']}`" if "command" in summary else "[results](/results.md)"
        steps = f"{len(summary['seeds'])} × {summary['env_steps']:,}"
        rows.append([f"[`{summary['preset']}`](/data/{file}.json)", steps, *cells, made])
    return markdown_table(["policy", "seeds × steps", *shown.values(), "made by"], rows)


def _command(known: dict[str, Any], who: str) -> str:
    """Return the command that measured a policy which learns nothing, or the best silent one."""
    places = (known.get("scripted", {}).get(who), known.get(who), (known.get("trained") or {}).get(who), known)
    return next((f"`{place['command']}`" for place in places if place and "command" in place), "")


def _estimated(values: list[float]) -> str:
    """Return the interquartile mean over seeds with its interval, as `gacrl compare` has it."""
    point, low, high = map(number, estimate(values))
    return f"{point} [{low}, {high}]"


def study(file: str, _: list[str]) -> str:
    """Return the returns that a study of `gacrl talk` found, every seed."""
    found = json.loads((DOCS / "data" / f"{file}.json").read_text(encoding="utf-8"))
    rows = {**found["returns"], **{f"talking, {how}": values for how, values in found["played"].items()}}
    return markdown_table(
        ["learner", "return, every seed"], ([who, " ".join(map(number, of))] for who, of in rows.items())
    )


def settings(task: str, _: list[str]) -> str:
    """Return the settings of a task, each with its default and the sentence under it in the source."""
    kind = type(tasks.default_settings(task))
    told: dict[str, str] = {}
    for base in reversed(kind.__mro__[:-1]):
        comments = ModuleAnalyzer.for_module(base.__module__).find_attr_docs()
        told |= {name: " ".join(words).strip() for (of, name), words in comments.items() if of == base.__name__}
    rows = [
        f"- `--env.{field.name.replace('_', '-')}` ({'none' if field.default is None else field.default}): "
        + told.get(field.name, "")
        for field in fields(kind)
        if field.init and field.default is not MISSING
    ]
    return "<details>\n<summary>Settings</summary>\n\n" + "\n".join(rows) + "\n\n</details>"


def api(_: str, names: list[str]) -> str:
    """Return directives that show the docstrings of names of the package."""
    shown = []
    for name in names:
        member = getattr(gacrl, name)
        kind = "class" if isinstance(member, type) else "function" if callable(member) else "data"
        options = "\n   :members:\n   :member-order: bysource" if kind == "class" else ""
        shown.append(f".. auto{kind}:: gacrl.{name}{options}\n")
    return "```{eval-rst}\n" + "\n".join(shown) + "```"
