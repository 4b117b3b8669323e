"""The command that compares runs."""

import json
import shlex
from collections.abc import Sequence
from typing import TYPE_CHECKING

from gacrl import tasks
from gacrl.cli.output import warn
from gacrl.cli.words import Words
from gacrl.errors import UserError

if TYPE_CHECKING:
    from gacrl.experiments.compare.replays import Gallery


def compare(words: Words) -> int:
    """Compare finished runs: tables on the screen, and where asked for a page and files."""
    from gacrl.cli import arguments, parsing

    asked = parsing.parse(arguments.Compare, words, "compare")
    from gacrl.experiments.compare import compare as comparing
    from gacrl.experiments.compare import data, pages, report

    for path in (asked.out and pages.file_of(asked.out), asked.marl_eval, asked.csv):
        if path is not None and path.exists() and not asked.overwrite:
            raise UserError(f"{path} exists: choose another place, or say --overwrite")
    if asked.out is not None and pages.file_of(asked.out) == asked.out and not asked.out.parent.is_dir():
        raise UserError(f"there is no folder {asked.out.parent} to write {asked.out.name} into")
    play = "sampled" if asked.sampled else "greedy"
    playing = asked.out is not None and asked.replays
    if playing or asked.horizon is not None:
        from gacrl.training.devices import prepare_jax

        prepare_jax()
    labels = [name for names in asked.label for name in names]
    comparison = comparing.compare(asked.run, asked.metric, play, warn, asked.margin, labels, asked.horizon)
    # Files first: whoever reads the tables may stop, or not understand the characters.
    written: list[str] = []
    if asked.out is not None:
        galleries: Sequence[Gallery] = ()
        if playing:
            from gacrl.experiments.compare import replays

            galleries = replays.record(comparison, warn)
        typed = shlex.join(word for word in words if word != "--overwrite")
        command = f"gacrl compare {typed}{tasks.flag(comparison.groups[0].config.task, as_given=True)}"
        written.append(f"page       {pages.write_page(comparison, asked.out, command, galleries)}")
    if asked.marl_eval is not None:
        asked.marl_eval.write_text(json.dumps(data.to_marl_eval(comparison)) + "\n", encoding="utf-8")
        written.append(f"marl-eval  {asked.marl_eval}")
    if asked.csv is not None:
        data.write_csv(comparison, asked.csv)
        written.append(f"csv        {asked.csv}")
    report.print_comparison(comparison)
    for line in written:
        print(line)
    if asked.json:
        print(json.dumps(data.to_dict(comparison)))
    return 0
