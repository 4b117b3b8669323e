"""Which code made the runs of a study, and what keeps its results from being followed to one commit.

A leaf: it reads files alone.
"""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from gacrl.versions import DIRTY

COMMIT = "git_commit"
Versions = Mapping[str, str]
"""Of packages and Python, and the commit of a checkout, as `versions.versions` writes them."""


def made_by(folders: Iterable[Path]) -> list[Versions]:
    """Return the versions that began and ended the runs in these folders, each once, in order of appearance."""
    found: list[Versions] = []
    for folder in folders:
        for name in ("origin.json", "summary.json"):
            versions = _versions_in(folder / name)
            if versions and versions not in found:
                found.append(versions)
    return found


def commits(made: Sequence[Versions]) -> list[str]:
    """Return the commits of the code, each once; `unknown` stands for an installed package."""
    return sorted({versions.get(COMMIT, "unknown") for versions in made})


def code_of(made: Sequence[Versions]) -> str:
    """Write the sentence that closes a report."""
    return f"Code of commit {', '.join(commits(made))}."


def doubts(made: Sequence[Versions]) -> Iterator[str]:
    """Yield a sentence for each thing that keeps results from being followed to one clean commit."""
    code = commits(made)
    if len(code) > 1:
        yield f"The runs are not of one version of the code, but of {', '.join(code)}."
    changed = [commit.removesuffix(DIRTY) for commit in code if commit.endswith(DIRTY)]
    if changed:
        yield (
            f"The sources had changes beside commit {', '.join(changed)}: no commit has the code that made these "
            "numbers."
        )
    names = sorted({name for versions in made for name in versions} - {COMMIT})
    differing = [name for name in names if len({versions.get(name) for versions in made}) > 1]
    if differing:
        yield f"The runs were made with different versions of {', '.join(differing)}."


def _versions_in(file: Path) -> dict[str, str]:
    """What a run's file says of them; nothing where it does not, or was written before files said it."""
    try:
        held: Any = json.loads(file.read_text(encoding="utf-8"))
        versions = held.get("versions", {})
        return {str(name): str(version) for name, version in versions.items()}
    except (OSError, ValueError, AttributeError):
        return {}
