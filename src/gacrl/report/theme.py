"""Colours and letters that all our pages share, light and dark: a style sheet that stands before each page's own."""

from importlib import resources


def theme() -> str:
    """Return the style sheet: custom properties of the root."""
    return (resources.files("gacrl.report") / "theme.css").read_text(encoding="utf-8")
