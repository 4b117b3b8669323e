"""The browser that pages are looked at in. Run, it prints where it is, and fails where there is none."""

import contextlib
import importlib.util
import shutil
import sys
from collections.abc import Generator
from typing import Any

NAMES = ("chromium", "chromium-browser", "google-chrome")


def path() -> str | None:
    """Where it is; None where there is none."""
    return next((found for name in NAMES if (found := shutil.which(name))), None)


def missing() -> str:
    """What is missing to look at a page; nothing where all is there."""
    if path() is None:
        return "there is no Chromium to look at pages in: apt-get install chromium"
    if importlib.util.find_spec("playwright") is None:
        return "there is no Playwright to look at pages with: pip install playwright"
    return ""


@contextlib.contextmanager
def opened() -> Generator[Any]:
    """The browser of this machine, driven by Playwright's client. A GPU that software plays makes frames come late."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path(), args=["--no-sandbox", "--disable-gpu"])
        yield browser
        browser.close()


if __name__ == "__main__":
    print(path() or "there is no Chromium")
    sys.exit(path() is None)
