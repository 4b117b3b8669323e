"""The model card beside exported weights: what somebody who has only the files must know."""

import json
from pathlib import Path
from typing import Any

from gacrl.config import files as configuration
from gacrl.errors import UserError
from gacrl.export import card_of
from gacrl.export.program import Program
from gacrl.export.source import Source
from gacrl.report.page import markdown_table
from gacrl.versions import version, versions


def write_card(source: Source, program: Program, out: Path, checked: str = "") -> Path:
    """Write the card of the policy in `out` beside it, as Markdown, and return where it is.

    checked: what was found when the file was tried.
    """
    path = card_of(out)
    path.write_text(card(source, program, out.name, checked), encoding="utf-8")
    return path


def card(source: Source, program: Program, file: str, checked: str = "") -> str:
    """Return the card: task, actions, architecture, tensors, training, what the policy reaches."""
    run, config = source.opened, source.opened.config
    settings = configuration.to_dict(config)
    names = run.task.actions(config.env)
    sections = {
        f"{file}: {config.task} by {config.algorithm.name}": f"{_summary(source, program)} {checked}".rstrip(),
        "Actions": _actions(names, run.env.num_actions, run.env.continuous_actions),
        "Inputs and outputs": _signature(program),
        "Architecture": _block(settings["algorithm"].get("network", settings["algorithm"])),
        "Tensors": markdown_table(
            ("name", "shape"), [(f"`{n}`", str(list(w.shape))) for n, w in program.weights.items()]
        ),
        "Task": _block(settings["env"]),
        "What it reaches": _reached(source),
        "Made by": markdown_table(("what", "version"), list(_made_by(source).items())),
    }
    first, *rest = sections.items()
    body = "\n".join(f"\n## {head}\n\n{text}" for head, text in rest)
    return f"# {first[0]}\n\n{first[1]}\n{body}\n"


def _summary(source: Source, program: Program) -> str:
    run, config = source.opened, source.opened.config
    size = sum(array.size for array in program.weights.values())
    return (
        f"The greedy policy of seed {config.seed} of the preset {config.preset} after {run.env_steps:,} environment "
        f"steps: {run.env.num_agents} agents, {size:,} numbers. All agents share them."
    )


def _actions(names: Any, count: int, continuous: bool) -> str:
    if continuous:
        return f"{count} numbers in [0, 1] for each agent: " + ", ".join(names)
    return markdown_table(("action", "meaning"), list(enumerate(names or ["not named by the task"] * count)))


def _signature(program: Program) -> str:
    outputs = program.outputs
    rows = [("in", f"`{name}`", f"{it.dtype}{list(it.shape)}") for name, it in program.inputs.items()]
    rows += [("out", f"`{name}`", f"{it.dtype}{list(it.shape)}") for name, it in outputs.items()]
    return markdown_table(("", "name", "numbers"), rows)


def _reached(source: Source) -> str:
    """The closing evaluation, mean over the seeds of the run, where the run has one."""
    summary = _summary_of(source)
    if not summary:
        return "No closing evaluation lies beside this run: `gacrl evaluate` makes one."
    means = {name: value["mean"] for name, value in summary["final"]["greedy"].items()}
    rows = [(name, "" if mean is None else f"{mean:.4g}") for name, mean in means.items()]
    seeds = ", ".join(map(str, summary["seeds"]))
    return (
        f"Greedy, {summary['episodes']} episodes of {summary['horizon']} steps, mean over the seeds {seeds}.\n\n"
        + markdown_table(("metric", "value"), rows)
    )


def _made_by(source: Source) -> dict[str, str]:
    """Return the versions that trained the run where it says so, and those of this export."""
    trained, now = _summary_of(source).get("versions", {}), versions()
    return {
        **{f"trained with {name}": number for name, number in trained.items()},
        "exported with gacrl": version(),
        "exported at commit": now.get("git_commit", "of a release"),
    }


def _summary_of(source: Source) -> dict[str, Any]:
    """Return the run's closing summary; {} where there is none. Raises UserError for a damaged one."""
    file = source.folder.summary_file
    if not file.is_file():
        return {}
    try:
        summary = json.loads(file.read_text(encoding="utf-8"))
        return {**summary, "final": {**summary["final"]}}
    except (ValueError, KeyError, TypeError) as error:
        raise UserError(f"{file} is damaged ({error}): move it away, and the card goes without it") from error


def _block(values: Any) -> str:
    return f"```json\n{json.dumps(values, indent=1)}\n```"
