"""What the documents and the help texts name is there: files, commands, flags and presets."""

import re
import shlex
from pathlib import Path
from typing import Any

import pytest

from gacrl.cli import arguments, parsing
from gacrl.cli import main as cli

ROOT = Path(__file__).parent.parent
PAGES = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]
PLACEHOLDERS = {"RUN", "FILE", "FOLDER", "SPEC", "NAME", "COMMAND", "ADDRESS", "H", "N", "X", "K"}


class Understood(BaseException):
    """The command line was parsed; nothing was done yet."""


def commands(text: str) -> list[list[str]]:
    """Every whole `gacrl` command in backticks, or on a line of its own in a block or a help text."""
    text = re.sub(r" *\\\n *", " ", text)  # a line that goes on
    found = re.findall(r"`gacrl ([^`]+)`|^ *gacrl ([^#\n]+)", text, flags=re.MULTILINE)
    lines = (re.split(r"  | > ", inline or line)[0] for inline, line in found)
    whole = (line for line in lines if not PLACEHOLDERS & set(re.findall(r"\w+", line)))
    return [words for words in map(shlex.split, whole) if words]


@pytest.fixture
def only_parsed(from_outside: None, monkeypatch: pytest.MonkeyPatch) -> None:
    parse = parsing._parsed

    def stop(*given: Any, **named: Any) -> None:
        parse(*given, **named)
        raise Understood

    monkeypatch.setattr(parsing, "_parsed", stop)
    monkeypatch.chdir(ROOT)  # the examples are named from there


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path):
    for link in re.findall(r"\]\(([^)#\s]+)", page.read_text(encoding="utf-8")):
        assert "://" in link or (page.parent / link).exists(), f"{page.name}: {link}"


def test_every_command_of_the_documents_and_of_help_is_understood(only_parsed: None):
    # The program prints these, in sentences that begin with a preset's name.
    printed = ("reproduction", "ablation-reference")
    written = [page for page in PAGES if page.parent.name not in printed]
    texts = [page.read_text(encoding="utf-8") for page in written]
    texts += [cli.OVERVIEW, *(kind.__doc__ or "" for kind in vars(arguments).values() if isinstance(kind, type))]
    said = [words for text in texts for words in commands(text) if "--config" not in words]
    assert {words[0] for words in said} >= set(cli.COMMANDS), "every command has an example"
    for words in map(list, dict.fromkeys(map(tuple, said))):  # each once
        if words[0] in cli.COMMANDS and len(words) > 1 and "--help" not in words:
            with pytest.raises(Understood):
                assert cli.main(words) == 0, f"gacrl {' '.join(words)}"


def test_every_setting_that_the_documents_name_exists():
    """Whole names: what stands as `.rounds` after one of them is not followed."""
    from gacrl.config import files as configuration
    from gacrl.config import presets

    def names(data: dict[str, Any], where: str = "") -> set[str]:
        inner = [names(value, f"{where}{key}.") for key, value in data.items() if isinstance(value, dict)]
        return {where + key for key in data}.union(*inner)

    known = set().union(*(names(configuration.to_dict(presets.preset(name))) for name in presets.PRESETS))
    pattern = r"`((?:algorithm|env|training|evaluation|curriculum)\.[a-z_.]+?)(?: [^`]*)?`"
    for page in PAGES:
        unknown = set(re.findall(pattern, page.read_text(encoding="utf-8"))) - known
        assert not {name for name in unknown if not name.startswith("training.devices")}, page.name


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_modules_that_the_documents_name_exist(page: Path):
    """As a path from one of the folders or as a tail of one; what an older house had is in the log."""
    here = {
        str(path.relative_to(ROOT))
        for folder in ("src", "tests", "benchmarks", "examples", "docs")
        for path in (ROOT / folder).rglob("*.py")
    }
    for named in set(re.findall(r"[`( ]([\w/]+\.py)\b", page.read_text(encoding="utf-8"))) - {"FILE.py"}:
        assert page.name == "log.md" or any(f"/{path}".endswith(f"/{named}") for path in here), named
