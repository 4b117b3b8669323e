"""The command that compares runs."""

import json

from gacrl.cli.output import warn
from gacrl.errors import UserError


def compare(words: list[str]) -> int:
    """Compare finished runs: tables on the screen, and where asked for a page and files."""
    from gacrl.cli import arguments, parsing

    asked = parsing.parse(arguments.Compare, words, "compare")
    from gacrl.experiments.compare import compare as comparing
    from gacrl.experiments.compare import data, pages, report

    files = ([asked.out / f"{pages.PAGE}.html"] if asked.out else []) + [asked.marl_eval, asked.csv]
    for path in files:
        if path is not None and path.exists() and not asked.overwrite:
            raise UserError(f"{path} exists: choose another place, or say --overwrite")
    play = "sampled" if asked.sampled else "greedy"
    if asked.horizon is not None:
        from gacrl.training.devices import prepare_jax

        prepare_jax()
    labels = [name for names in asked.label for name in names]
    comparison = comparing.compare(asked.run, asked.metric, play, warn, asked.margin, labels, asked.horizon)
    # Files first: whoever reads the tables may stop, or not understand the characters.
    written: list[str] = []
    if asked.out is not None:
        written.append(f"page       {pages.write_page(comparison, asked.out)}")
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
