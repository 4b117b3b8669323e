"""What the site shows of files and of the package: scores, studies, settings, docstrings."""

import json
from collections.abc import Iterable
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any

from sphinx.pycode import ModuleAnalyzer

import gacrl
from gacrl import tasks
from gacrl.experiments import anchors

DOCS = Path(__file__).resolve().parent.parent


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Return a table in Markdown."""
    head = list(head)
    marks = [f"| {' | '.join(cells)} |" for cells in (head, ["---"] * len(head), *rows)]
    return "\n".join(marks)


def number(value: float) -> str:
    """Return a number with three digits that count, and the sign that the documents have."""
    shown = f"{value:.2f}" if abs(value) >= 0.995 else f"{value:.3f}"
    return shown.replace("-", "−")


def scores(task: str, files: list[str]) -> str:
    """Return what is known of a task: policies that learn nothing, then a row for each file of docs/data."""
    known = tasks.find(task).known()
    summaries = {file: json.loads((DOCS / "data" / f"{file}.json").read_text(encoding="utf-8")) for file in files}
    shown = tasks.find(task).shown(list(next(iter(summaries.values()))["final"]["greedy"]))
    rows = [
        [f"{who}, scripted", "", *(number(of[name]) if name in of else "" for name in shown)]
        for who, of in known["scripted"].items()
    ]
    for file, summary in summaries.items():
        final = summary["final"]["greedy"]
        seeds = f"{len(summary['seeds'])} × {summary['env_steps']:,}"
        cells = [f"{number(final[name]['mean'])} {_interval(final[name]['interval'])}" for name in shown]
        rows.append([f"[`{summary['preset']}`](/data/{file}.json)", seeds, *cells])
    below = f"*{anchors.row(task)['summary']}. Scripted policies: `{known['command']}`. Learned ones: the mean over "
    below += "their seeds and its 95 % interval, of the closing evaluation, greedy; their names lead to the data.*"
    return f"{table(['policy', 'seeds × steps', *shown.values()], rows)}\n\n{below}"


def _interval(ends: list[float]) -> str:
    return f"[{', '.join(map(number, ends))}]"


def study(file: str, _: list[str]) -> str:
    """Return the returns that a study of `gacrl talk` found, every seed."""
    found = json.loads((DOCS / "data" / f"{file}.json").read_text(encoding="utf-8"))
    rows = {**found["returns"], **{f"talking, {how}": values for how, values in found["played"].items()}}
    return table(["learner", "return, every seed"], ([who, " ".join(map(number, of))] for who, of in rows.items()))


def settings(task: str, _: list[str]) -> str:
    """Return the settings of a task, each with its default and the sentence under it in the source."""
    kind = type(tasks.default_settings(task))
    told: dict[str, str] = {}
    for base in reversed(kind.__mro__[:-1]):
        comments = ModuleAnalyzer.for_module(base.__module__).find_attr_docs()
        told |= {name: " ".join(words).strip() for (of, name), words in comments.items() if of == base.__name__}
    rows = [
        [f"`--env.{field.name.replace('_', '-')}`", _default(field.default), told.get(field.name, "")]
        for field in fields(kind)
        if field.init and field.default is not MISSING
    ]
    return table(["setting", "default", "what it is"], rows)


def _default(value: Any) -> str:
    return f"`{value}`".replace("|", r"\|")


def api(_: str, names: list[str]) -> str:
    """Return directives that show the docstrings of names of the package."""
    shown = []
    for name in names:
        member = getattr(gacrl, name)
        kind = "class" if isinstance(member, type) else "function" if callable(member) else "data"
        options = "\n   :members:\n   :member-order: bysource" if kind == "class" else ""
        shown.append(f".. auto{kind}:: gacrl.{name}{options}\n")
    return "```{eval-rst}\n" + "\n".join(shown) + "```"
