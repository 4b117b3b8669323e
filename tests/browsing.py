"""Pages of ours in a headless Chromium, opened from disk."""

import importlib.util
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


def missing() -> str:
    """What is missing to look at a page, as the reason of a skipped test; nothing where all is there."""
    if CHROMIUM is None:
        return "there is no Chromium to look at pages in: apt-get install chromium"
    if importlib.util.find_spec("playwright") is None:
        return "there is no Playwright to look at pages with: pip install playwright"
    return ""


def opened() -> Iterator[Any]:
    """The browser of this machine, driven by Playwright's client."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield browser
        browser.close()


class Visit:
    """A page in the browser; its errors, and what it asks the network for, are kept."""

    def __init__(self, browser: Any, path: Path, fragment: str = "", width: int = 1200, name: str = "gacrlPage"):
        """name: of what the page shows to tests."""
        self.page = browser.new_page(viewport={"width": width, "height": 900}, reduced_motion="reduce")
        self.wrong: list[str] = []
        self.asked: list[str] = []
        self.page.on("pageerror", lambda error: self.wrong.append(str(error)))
        self.page.on(
            "console", lambda said: self.wrong.append(said.text) if said.type in ("error", "warning") else None
        )
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.page.goto(path.as_uri() + fragment)
        self.until(f"globalThis.{name} !== undefined")

    def until(self, expression: str) -> None:
        """Wait for it. (Playwright's own waiting evaluates text, which the page's policy forbids.)"""
        deadline = time.monotonic() + 60  # frames come late where several browsers share two cores
        while not self.page.evaluate(expression):
            assert time.monotonic() < deadline, expression
            time.sleep(0.05)

    def __call__(self, expression: str, argument: Any = None) -> Any:
        """What an expression is there."""
        return self.page.evaluate(expression, argument)

    def press(self, *keys: str) -> None:
        """Press keys, one after the other."""
        for key in keys:
            self.page.keyboard.press(key)

    def focus(self, identity: str) -> None:
        """Tab to the element of that id, as somebody without a pointer does."""
        for _ in range(80):
            if self("document.activeElement.id") == identity:
                return
            self.press("Tab")
        raise AssertionError(f"no way leads to {identity}")

    def close(self) -> None:
        """Whatever happened, nothing went wrong and nothing was loaded."""
        assert self.wrong == []
        assert [url for url in self.asked if not url.startswith("file:")] == [] and len(self.asked) == 1
        self.page.close()
