"""Write the pages of docs/pages: every policy that comes with the package, as `gacrl export` writes it.

    python benchmarks/pages.py
    python benchmarks/pages.py --dress    keeps what is in them, and takes script and style of now

The same policies give the same bytes.
"""

import html
import json
import re
import sys
from pathlib import Path

from gacrl import play
from gacrl.cli import main as cli
from gacrl.export import bundle

PAGES = Path(__file__).parent.parent / "docs" / "pages"


def dressed(page: str) -> str:
    """Return a page with its data and with the script, style and text of now."""
    title, data = (
        re.search(part, page, re.DOTALL) for part in ("<title>(.*?)</title>", 'id="data">(.*?)</script>')
    )
    assert title is not None and data is not None
    return bundle.page(html.unescape(title[1]), json.loads(data[1]))


def main() -> None:
    """Export them all, in the place of those that are there."""
    if sys.argv[1:] == ["--dress"]:
        for path in PAGES.glob("*.html"):
            path.write_text(dressed(path.read_text(encoding="utf-8")), encoding="utf-8")
        return
    PAGES.mkdir(exist_ok=True)
    for name in play.pretrained():
        out = str(PAGES / f"{name}.html")
        if cli.main(["export", f"pretrained:{name}", "--out", out, "--overwrite"]):
            raise SystemExit(f"{name} was not exported")


if __name__ == "__main__":
    main()
