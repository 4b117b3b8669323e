"""Blocks of the site's pages that are filled while it is built: what commands print, pictures, scores, docstrings.

A block is fenced as any code, and begins with `{NAME}`:

    {run}       commands, one a line; each is shown with what it prints. `{run} quietly` leaves that out
    {picture}   a command that writes a GIF or PNG by --out, which is shown; the alternative text follows the name
    {excerpt}   a part of another page: the file, then how it begins, then what follows it, or END
    {scores}    a task's scores: scripted policies, and runs by the files that hold their summaries
    {study}     what `gacrl talk` found, from the file that holds its summary
    {settings}  the settings of a task, each with its default and what its source says about it
    {api}       docstrings of names of the package, one a line
"""

import hashlib
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import tables

ROOT = Path(__file__).resolve().parent.parent.parent
BLOCK = re.compile(r"^```\{(\w+)\}([^\n]*)\n(.*?)^```$", flags=re.DOTALL | re.MULTILINE)
KINDS = ("run", "picture", "excerpt", "scores", "study", "settings", "api")
WIDTH = 84
"""Characters in a line of what is printed: as many as fit beside the site's menus."""


def commands(page: str) -> list[str]:
    """Return every command that the blocks of a page run, in its order."""
    return [line for kind, _, body in BLOCK.findall(page) if kind in ("run", "picture") for line in lines(body)]


def lines(body: str) -> list[str]:
    """Return the lines of a block, those that go on behind a backslash put together."""
    return [line for line in re.sub(r" *\\\n *", " ", body).splitlines() if line.strip()]


def fill(page: str, made: "Made", excerpt: Callable[[str, str, str], str]) -> str:
    """Return a page with its blocks filled. excerpt: gives a part of another page. Raises KeyError."""

    def filled(match: re.Match[str]) -> str:
        kind, named, body = match[1], match[2].strip(), match[3]
        if kind not in KINDS:
            return match[0]  # one of MyST's own
        if kind == "run":
            if named == "quietly":
                return f"```bash\n{body}```"
            return "\n\n".join(f"```bash\n{asked}\n```\n\n{made.printed(asked)}" for asked in lines(body))
        if kind == "picture":
            words = shlex.split(body)
            picture = words[words.index("--out") + 1]
            shown = f"![{named}](/made/{picture})"
            if picture.endswith(".png"):  # a strip: wide
                shown = f'<div class="strip">\n\n{shown}\n\n</div>'
            return f"{shown}\n\n```bash\n{body}```"
        if kind == "excerpt":
            return excerpt(named, *lines(body))
        return getattr(tables, kind)(named, lines(body))

    return BLOCK.sub(filled, page)


class Made:
    """What the commands of the site printed and wrote. Commands run again only where they or the program changed."""

    def __init__(self, wanted: list[str], place: Path):
        self.wanted, self.folder = wanted, place / _digest(wanted)

    def run(self) -> None:
        """Run all commands, one after the other, in a folder that has the examples. Raises SystemExit."""
        if (self.folder / "done").exists():
            return
        shutil.rmtree(self.folder.parent, ignore_errors=True)
        self.folder.mkdir(parents=True)
        (self.folder / "examples").symlink_to(ROOT / "examples")
        surroundings = {**os.environ, "COLUMNS": str(WIDTH), "PYTHONPATH": str(ROOT / "src")}
        for number, command in enumerate(self.wanted, 1):
            print(f"{number} of {len(self.wanted)}: {command}", flush=True)
            name, *words = shlex.split(command)
            if name != "gacrl":
                raise SystemExit(f"the site runs gacrl alone, not {name}")
            called = [sys.executable, "-m", "gacrl", *words]
            done = subprocess.run(called, cwd=self.folder, env=surroundings, capture_output=True, text=True)
            if done.returncode:
                raise SystemExit(f"{command} ends with {done.returncode}:\n{done.stdout}{done.stderr}")
            self._printed(command).write_text(done.stdout, encoding="utf-8")
        (self.folder / "done").touch()

    def printed(self, command: str) -> str:
        """Return what a command printed, as a block of text."""
        text = self._printed(command).read_text(encoding="utf-8").strip("\n")
        text = text.replace(f"{self.folder}/", "")  # as they are seen from there
        return "\n".join(["```text", *map(str.rstrip, text.splitlines()), "```"])

    def pictures(self) -> list[Path]:
        """Return the pictures that the commands wrote into their folder."""
        return [path for path in self.folder.iterdir() if path.suffix in (".gif", ".png")]

    def _printed(self, command: str) -> Path:
        return self.folder / f"{hashlib.sha256(command.encode()).hexdigest()[:16]}.txt"


def _digest(wanted: list[str]) -> str:
    """Tell apart lists of commands, and states of the program and of the examples."""
    told = hashlib.sha256("\n".join([*wanted, str(WIDTH)]).encode())
    for path in sorted([*(ROOT / "src").rglob("*"), *(ROOT / "examples").rglob("*.py")]):
        if path.is_file() and "__pycache__" not in path.parts:
            told.update(path.read_bytes())
    return told.hexdigest()[:16]
