"""Write the pages of docs/pages: every policy that comes with the package, as `gacrl export` writes it.

    python benchmarks/pages.py

The same policies give the same bytes.
"""

from pathlib import Path

from gacrl import play
from gacrl.cli import main as cli

PAGES = Path(__file__).parent.parent / "docs" / "pages"


def main() -> None:
    """Export them all, in the place of those that are there."""
    PAGES.mkdir(exist_ok=True)
    for name in play.pretrained():
        out = str(PAGES / f"{name}.html")
        if cli.main(["export", f"pretrained:{name}", "--out", out, "--overwrite"]):
            raise SystemExit(f"{name} was not exported")


if __name__ == "__main__":
    main()
