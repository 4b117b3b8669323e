"""The notebook and the site: the tour is run as it stands, and the site leaves no command and no name out."""

import importlib.util
import json
import re
import shutil
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

import gacrl
from gacrl.cli import main as cli

ROOT = Path(__file__).parent.parent
SITE = ROOT / "docs" / "site"


@pytest.fixture
def notebook() -> ModuleType:
    """The site's own way to run one."""
    spec = importlib.util.spec_from_file_location("notebook", SITE / "notebook.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.soak
def test_the_tour(notebook: ModuleType, from_outside: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The agents learn to talk, say something else for each place, and fail in silence; each plot has its picture."""
    shutil.copy(ROOT / "examples" / "own_task.py", tmp_path)
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    shown = list(notebook.run(ROOT / "examples" / "tour.ipynb", names))
    assert names["heard"]["return_agent_mean"].mean > 5
    assert names["silent"]["return_agent_mean"].mean < 2
    assert len(set(names["words"].values())) == 5
    assert [len(cell.pictures) for cell in shown if cell.kind == "code"] == [0, 0, 0, 0, 1]
    assert "return 5." in next(cell.text for cell in shown if cell.kind == "code")


def test_cells_are_shown_as_in_jupyter(notebook: ModuleType, tmp_path: Path):
    """What is printed, then the last line's value, unless it is None or ends in a semicolon; names are kept."""
    sources = ["a = 20\nprint('so')\na + 1", "b = a", "a;", "import matplotlib.pyplot as plt\nplt.plot([1, 2]);"]
    cells = [{"cell_type": "code", "source": source.splitlines(keepends=True)} for source in sources]
    (tmp_path / "a.ipynb").write_text(json.dumps({"cells": cells}))
    shown = list(notebook.run(tmp_path / "a.ipynb", {}))
    assert [cell.text for cell in shown] == ["so\n21\n", "", "", ""]
    assert [len(cell.pictures) for cell in shown] == [0, 0, 0, 1]
    page = notebook.page(shown)
    assert "```text\nso\n21\n```" in page and page.count("```text") == 1
    assert page.count("data:image/png;base64,iVBOR") == 1


def test_the_tour_is_kept_without_what_it_gave():
    tour = json.loads((ROOT / "examples" / "tour.ipynb").read_text(encoding="utf-8"))
    code = [cell for cell in tour["cells"] if cell["cell_type"] == "code"]
    assert tour["nbformat"] == 4 and code
    assert all(cell["outputs"] == [] and cell["execution_count"] is None for cell in code)


def test_every_command_has_a_page_with_its_help():
    for name in cli.COMMANDS:
        page = (SITE / "commands" / f"{name}.md").read_text(encoding="utf-8")
        assert page.startswith(f"# gacrl {name}\n")
        assert f"```{{run}}\ngacrl {name} --help\n```" in page
        assert re.search(
            rf"^```\{{(run|picture|excerpt|study)\}}[^\n]*\n(?!gacrl {name} --help)", page, re.MULTILINE
        )


def test_every_name_is_in_the_api():
    page = (SITE / "api.md").read_text(encoding="utf-8")
    named = [name for block in re.findall(r"```\{api\}\n(.*?)```", page, re.DOTALL) for name in block.split()]
    assert sorted(named) == sorted(gacrl.__all__)
