"""A page of headings, paragraphs, tables and figures, written as one HTML file and as Markdown.

The same content gives the same bytes. The HTML needs nothing else: figures and style are in it, scripts are not.
"""

import html
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gacrl.errors import UserError, reason
from gacrl.report.safe import digest, embedded
from gacrl.report.theme import theme

_POLICY = "default-src 'none'; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'"
"""Nothing is loaded. SVG has its style in its elements."""
_STYLE = """\
body { max-width: 62rem; margin: 2rem auto; padding: 0 1rem; color: var(--ink); background: Canvas; }
@media (prefers-color-scheme: dark) {
  body { background: #0e1216; }
  figure.plot svg { filter: invert(.93) hue-rotate(180deg); }
}
h1, h2, h3, h4 { line-height: 1.25; margin: 2rem 0 .6rem; overflow-wrap: anywhere; }
h1 { margin-top: 0; }
p { overflow-wrap: anywhere; }
.wide { overflow-x: auto; margin: 1.2rem 0; }
.wide > table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: .92rem; }
.wide caption { caption-side: top; text-align: left; font-weight: 600; padding-bottom: .3rem; }
.wide th, .wide td { padding: .3rem .8rem .3rem 0; text-align: left; vertical-align: top;
  border-bottom: 1px solid var(--border); }
.wide th { border-bottom: 2px solid var(--faint); }
figure.plot { margin: 1.6rem 0; overflow-x: auto; }
figure.plot svg { max-width: 100%; height: auto; }
@media (max-width: 40rem) { figure.plot svg { max-width: none; } }
figcaption { color: var(--faint); font-size: .92rem; }
pre { background: var(--panel); padding: .7rem 1rem; overflow-x: auto; }
details { margin: .8rem 0; }
summary { cursor: pointer; font-weight: 600; }
:focus-visible { outline: 3px solid var(--accent); outline-offset: 2px; }"""


@dataclass(frozen=True)
class _Heading:
    text: str
    level: int

    def as_html(self) -> str:
        return f"<h{self.level}>{html.escape(self.text)}</h{self.level}>"

    def as_markdown(self, figures: str) -> str:
        return f"{'#' * self.level} {_plain(self.text)}"


@dataclass(frozen=True)
class _Text:
    text: str

    def as_html(self) -> str:
        return f"<p>{html.escape(self.text)}</p>"

    def as_markdown(self, figures: str) -> str:
        return _paragraph(self.text)


@dataclass(frozen=True)
class _Code:
    text: str

    def as_html(self) -> str:
        return f"<pre><code>{html.escape(self.text)}</code></pre>"

    def as_markdown(self, figures: str) -> str:
        longest = max((len(run) for run in re.findall("`+", self.text)), default=0)
        fence = "`" * max(3, longest + 1)
        return f"{fence}\n{self.text}\n{fence}"


@dataclass(frozen=True)
class _Details:
    summary: str
    text: str

    def as_html(self) -> str:
        return f"<details><summary>{html.escape(self.summary)}</summary>{_Code(self.text).as_html()}</details>"

    def as_markdown(self, figures: str) -> str:
        return f"{_paragraph(self.summary)}\n\n{_Code(self.text).as_markdown(figures)}"


@dataclass(frozen=True)
class _Live:
    style: str
    script: str
    data: str
    said: str

    def as_html(self) -> str:
        return (
            f'<section id="live"></section>\n<script type="application/json" id="live-data">{self.data}</script>\n'
            f'<script type="module">{self.script}</script>'
        )

    def as_markdown(self, figures: str) -> str:
        return _paragraph(self.said)


@dataclass(frozen=True)
class _Table:
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    caption: str

    def as_html(self) -> str:
        caption = f"<caption>{html.escape(self.caption)}</caption>\n" if self.caption else ""
        head = "".join(f'<th scope="col">{html.escape(name)}</th>' for name in self.columns)
        body = "\n".join(
            "<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in self.rows
        )
        return (
            f'<div class="wide"><table>\n{caption}<thead><tr>{head}</tr></thead>\n'
            f"<tbody>\n{body}\n</tbody>\n</table></div>"
        )

    def as_markdown(self, figures: str) -> str:
        columns, *rows = [[_plain(cell) for cell in row] for row in (self.columns, *self.rows)]
        caption = f"{_paragraph(self.caption)}\n\n" if self.caption else ""
        return caption + markdown_table(columns, rows)


@dataclass(frozen=True)
class _Figure:
    svg: str
    caption: str
    name: str

    def as_html(self) -> str:
        inline = re.sub(
            r"<svg\b", f'<svg role="img" aria-label="{html.escape(self.caption)}"', self.inline(), count=1
        )
        return f'<figure class="plot">\n{inline}\n<figcaption>{html.escape(self.caption)}</figcaption>\n</figure>'

    def as_markdown(self, figures: str) -> str:
        caption = _plain(self.caption)
        return f"![{caption.replace(']', '&#93;')}]({figures}/{self.name}.svg)\n\n*{caption}*"

    def inline(self) -> str:
        """Return the svg element alone; its ids carry the figure's name, since a page holds several figures."""
        element = self.svg[self.svg.index("<svg") :].strip()
        element = re.sub(r'\bid="', f'id="{self.name}-', element)
        element = re.sub(r'href="#', f'href="#{self.name}-', element)
        return element.replace("url(#", f"url(#{self.name}-")


class Page:
    """A page under construction; what is added stands in that order. All text is plain, and escaped."""

    def __init__(self, title: str):
        self.title = title
        self._blocks: list[_Heading | _Text | _Code | _Details | _Live | _Table | _Figure] = []

    def heading(self, text: str, level: int = 2) -> None:
        """Add a heading of level 2 to 4; the title is level 1."""
        if not 2 <= level <= 4:
            raise ValueError(f"a heading has level 2 to 4, not {level}")
        self._blocks.append(_Heading(text, level))

    def text(self, paragraph: str) -> None:
        """Add a paragraph."""
        self._blocks.append(_Text(paragraph))

    def code(self, text: str) -> None:
        """Show commands or a listing, line by line."""
        self._blocks.append(_Code(text))

    def details(self, summary: str, text: str) -> None:
        """Add a listing that is folded away under its summary."""
        self._blocks.append(_Details(summary, text))

    def live(self, style: str, script: str, data: Any, said: str) -> None:
        """Add a part that a script of ours fills: the element `live`, from the data in `live-data`. One a page.

        style, script: files of this package. said: what stands in Markdown instead.
        """
        self._blocks.append(_Live(style, script, embedded(data), said))

    def table(self, columns: Sequence[str], rows: Sequence[Sequence[str]], caption: str = "") -> None:
        """Add a table; every row has as many cells as there are columns. Raises ValueError for one that has not."""
        for row in rows:
            if len(row) != len(columns):
                raise ValueError(f"a row has {len(row)} cells under {len(columns)} columns: {list(row)}")
        self._blocks.append(_Table(tuple(columns), tuple(map(tuple, rows)), caption))

    def figure(self, svg: str, caption: str, name: str) -> None:
        """Add a figure. svg: the text of an SVG file; name: of its file beside the Markdown, without ending.

        Raises ValueError for a name that is taken, or is more than letters, digits, - and _.
        """
        if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_-]*", name):
            raise ValueError(f"a figure's name is letters, digits, - and _, not {name!r}")
        if any(figure.name == name for figure in self._figures()):
            raise ValueError(f"there is a figure {name!r} already")
        if "<svg" not in svg:
            raise ValueError(f"the figure {name!r} is not SVG")
        self._blocks.append(_Figure(svg, caption, name))

    def html(self) -> str:
        """Return the whole page as one HTML file."""
        title = html.escape(self.title)
        live = [block for block in self._blocks if isinstance(block, _Live)]
        scripts = " ".join(f"'{digest(block.script)}'" for block in live) or "'none'"
        policy = f"{_POLICY}; script-src {scripts}"
        style = "\n".join([theme(), _STYLE, *(block.style for block in live)])
        blocks = "\n".join(block.as_html() for block in self._blocks)
        return (
            f'<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
            f'<meta http-equiv="Content-Security-Policy" content="{html.escape(policy)}">\n'
            '<meta name="color-scheme" content="light dark">\n'
            f'<meta name="viewport" content="width=device-width, initial-scale=1">\n<title>{title}</title>\n'
            f"<style>\n{style}\n</style>\n</head>\n<body>\n<h1>{title}</h1>\n{blocks}\n</body>\n</html>\n"
        )

    def markdown(self, figures: str) -> str:
        """Return the page as Markdown; figures: the folder of its SVG files, relative to it."""
        return (
            "\n\n".join([f"# {_plain(self.title)}", *(block.as_markdown(figures) for block in self._blocks)])
            + "\n"
        )

    def write(self, folder: Path, name: str) -> Path:
        """Write `name.html`, `name.md` and `name-figures/*.svg`, over those of before; return the HTML file.

        Raises UserError where the folder cannot be written.
        """
        figures = f"{name}-figures"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            (folder / f"{name}.md").write_text(self.markdown(figures), encoding="utf-8")
            for figure in self._figures():
                (folder / figures).mkdir(exist_ok=True)
                (folder / figures / f"{figure.name}.svg").write_text(figure.svg, encoding="utf-8")
        except OSError as error:
            raise UserError(
                f"cannot write {name}.html into {folder}: {reason(error)}; choose another --out"
            ) from error
        return self.write_html(folder / f"{name}.html")

    def write_html(self, path: Path) -> Path:
        """Write the page as one HTML file and return where it is. Raises UserError where it cannot be written."""
        try:
            path.write_text(self.html(), encoding="utf-8")
        except OSError as error:
            raise UserError(f"cannot write {path}: {reason(error)}; choose another --out") from error
        return path

    def _figures(self) -> list[_Figure]:
        return [block for block in self._blocks if isinstance(block, _Figure)]


def markdown_table(columns: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Write a table in Markdown, its cells as they are."""
    lines = (columns, ["---"] * len(columns), *rows)
    return "\n".join(f"| {' | '.join(map(str, cells))} |" for cells in lines)


def _plain(text: str) -> str:
    """Text on one line that Markdown shows as it is; underscores within words mean nothing to it."""
    text = html.escape(" ".join(text.split()), quote=False)
    return re.sub(r"([\\`*\[|~]|(?<!\w)_|_(?!\w))", r"\\\1", text)


def _paragraph(text: str) -> str:
    """The same where a line begins, which must not make it a list or a heading."""
    text = _plain(text)
    return re.sub(r"^(\d*)([#>+=.)-])", r"\1\\\2", text)
