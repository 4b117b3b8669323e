"""What is known of a task before anybody learns it: scores of random, silent and told policies."""

from typing import Any

from gacrl import tasks
from gacrl.tasks.task import SILENT, TOLD

SCORED = ("random", SILENT, TOLD)
"""Whose scores a table of tasks has: uniformly random actions, the best policy without a word, and one that is told
everything."""


def row(name: str) -> dict[str, Any]:
    """Return what must be done in a task, and the scores of its headline: None where nobody has measured one."""
    task = tasks.find(name)
    known = task.known()
    scores = known.get("scores", {})
    return {
        "task": name,
        "summary": task.summary,
        "headline": task.headline,
        "scores": {who: scores.get(who) for who in SCORED},
        "command": known.get("command"),
    }


def sentence(row: dict[str, Any]) -> str:
    """Return the row as a line."""
    told = [f"{who} {score:.2f}" for who, score in row["scores"].items() if score is not None]
    scores = f"; {row['headline']}: {', '.join(told)}" if told else ""
    return f"{row['task']:16}  {row['summary']}{scores}"
