"""Lay out the sources of the documentation site: every page of docs/, and what is made while it is built.

python docs/site/stage.py FOLDER     `make docs` calls it, and then Sphinx

A page keeps its place under docs/; README, the changelog and CONTRIBUTING come beside them, and every Python file that
a page links to becomes a page. Links between files of the repository become links between pages. FOLDER/source is what
Sphinx reads, FOLDER/whole what it copies as it is, FOLDER/work what commands wrote.
"""

import contextlib
import os
import re
import shutil
import sys
import tempfile
from pathlib import Path

import blocks
import notebook

from gacrl.cli.main import COMMANDS

ROOT = blocks.ROOT
SITE = ROOT / "docs" / "site"
MOVED = {
    ROOT / "README.md": "index.md",
    ROOT / "docs" / "site" / "index.md": "index.md",
    ROOT / "CHANGELOG.md": "changelog.md",
    ROOT / "CONTRIBUTING.md": "contributing.md",
    ROOT / "examples" / "tour.ipynb": "tour.md",
}
"""Pages that do not lie where they are shown."""
LINK = re.compile(r"(?<=\]\()([^)#\s]+)(#[^)\s]*)?(?=\))")
UNTITLED = re.compile(r"(?<!!)\[(?:[\w-]+/)*[\w-]+\.md\](?=\(/)")
"""The text of a link that only repeats a page's path: the site has its title there."""
WHOLE = re.compile(r"\[([^\[\]]+)\]\((/[^)\s]+\.html)\)")
"""A link to an HTML file that is copied as it is: one that Sphinx leaves alone."""


def pages() -> list[Path]:
    """Return the pages that are written by hand, those of the site's own folder first."""
    docs = ROOT / "docs"
    own = sorted(SITE.rglob("*.md"))
    others = [path for path in sorted(docs.rglob("*.md")) if SITE not in path.parents]
    return [*own, *others, ROOT / "CHANGELOG.md", ROOT / "CONTRIBUTING.md"]


def place(path: Path) -> str:
    """Return where a file of the repository is found on the site, from its root."""
    if path in MOVED:
        return MOVED[path]
    if path.suffix == ".py":
        return f"code/{path.relative_to(ROOT).with_suffix('.md')}"
    base = SITE if SITE in path.parents else ROOT / "docs"
    return str(path.relative_to(base))


class Stage:
    """The folder that is laid out, and the Python files that its pages link to."""

    def __init__(self, folder: Path, made: blocks.Made):
        self.folder, self.made, self.code = folder, made, set((ROOT / "examples").glob("*.py"))

    def write(self, where: str, text: str) -> None:
        """Write a page."""
        path = self.folder / "source" / where
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")

    def add(self, page: Path) -> None:
        """Add a page with its blocks filled."""
        text = self.linked(page.read_text(encoding="utf-8"), page)

        def excerpt(file: str, begins: str, ends: str) -> str:
            other = (page.parent / file).resolve()
            whole = self.linked(other.read_text(encoding="utf-8"), other)
            start = whole.find(begins)
            end = len(whole) if ends == "END" else whole.find(ends, start + len(begins))
            if min(start, end) < 0:
                raise SystemExit(f"{page.relative_to(ROOT)}: {file} has no {begins!r}, or no {ends!r} behind it")
            return whole[start:end]

        where = place(page)
        up = os.path.relpath(".", Path(where).parent)
        filled = blocks.fill(text, self.made, excerpt)
        self.write(where, WHOLE.sub(rf'<a href="{up}\2">\1</a>', filled))

    def linked(self, text: str, page: Path) -> str:
        """Return a page's text with its links to files, outside of code, made links from the site's root."""

        def link(match: re.Match[str]) -> str:
            target, anchor = match[1], match[2] or ""
            path = (page.parent / target).resolve()
            if "://" in target or not path.is_file():
                return match[0]
            if path.suffix == ".py":
                self.code.add(path)
            return f"/{place(path)}{anchor}"

        parts = re.split(r"(^```.*?^```$)", text, flags=re.DOTALL | re.MULTILINE)
        return "".join(
            part if part.startswith("```") else UNTITLED.sub("[]", LINK.sub(link, part)) for part in parts
        )

    def add_code(self) -> None:
        """Add a page for each Python file that is linked to, and for each example."""
        for path in self.code:
            shown, where = path.relative_to(ROOT), place(path)
            self.write(where.removesuffix(".md") + ".py", path.read_text(encoding="utf-8"))
            orphan = "" if shown.parts[0] == "examples" else "---\norphan: true\n---\n\n"
            self.write(where, f"{orphan}# {shown}\n\n```{{literalinclude}} {path.name}\n:language: python\n```\n")

    def add_files(self) -> None:
        """Add what pages show or link to: figures and data, and HTML as it is."""
        docs = ROOT / "docs"
        for path in sorted(docs.rglob("*")):
            if path.is_file() and SITE not in path.parents and path.suffix != ".md":
                kind = "whole" if path.suffix == ".html" else "source"
                self.copy(path, f"{kind}/{path.relative_to(docs)}")
        for picture in self.made.pictures():
            self.copy(picture, f"source/made/{picture.name}")
        for own in (SITE / "conf.py", *(SITE / "static").iterdir()):
            self.copy(own, f"source/{own.relative_to(SITE)}")

    def copy(self, path: Path, where: str) -> None:
        """Copy a file into the folder."""
        target = self.folder / where
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, target)

    def add_tour(self) -> None:
        """Run the notebook in an empty folder, and add it with what its cells give."""
        tour = ROOT / "examples" / "tour.ipynb"
        kept = self.made.folder / "tour.md"
        if not kept.exists() or kept.stat().st_mtime < tour.stat().st_mtime:
            print("the tour", flush=True)
            with tempfile.TemporaryDirectory() as empty, contextlib.chdir(empty):
                shutil.copy(ROOT / "examples" / "own_task.py", empty)
                page = notebook.page(list(notebook.run(tour, {})))
                kept.write_text(page.replace(f"{Path.cwd()}/", ""), encoding="utf-8")
        self.write(place(tour), self.linked(kept.read_text(encoding="utf-8"), tour))


def main(folder: Path) -> None:
    """Lay out the sources in a folder."""
    written = pages()
    wanted = [command for page in _in_order(written) for command in blocks.commands(page.read_text("utf-8"))]
    made = blocks.Made(wanted, folder / "work")
    made.run()
    for kind in ("source", "whole"):
        shutil.rmtree(folder / kind, ignore_errors=True)
    stage = Stage(folder, made)
    for page in written:
        stage.add(page)
    stage.add_tour()
    stage.add_code()
    stage.add_files()


def _in_order(written: list[Path]) -> list[Path]:
    """Return pages in the order in which their commands run: those of commands as `gacrl --help` lists them."""
    listed = list(COMMANDS)
    names = {page: listed.index(page.stem) for page in written if page.parent.name == "commands"}
    return sorted(written, key=lambda page: names.get(page, len(listed)))


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve())
