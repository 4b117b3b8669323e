"""Pages of ours in a headless Chromium."""

import importlib.util
import time
from pathlib import Path
from typing import Any

_SPEC = importlib.util.spec_from_file_location(
    "chromium", Path(__file__).parents[1] / "benchmarks" / "chromium.py"
)
assert _SPEC is not None and _SPEC.loader is not None
chromium = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(chromium)


class Visit:
    """A page in the browser; its errors, and what it asks the network for, are kept."""

    def __init__(
        self,
        browser: Any,
        address: str | Path,
        fragment: str = "",
        width: int = 1200,
        name: str = "gacrlPage",
        scheme: str = "light",
    ):
        """address: a file, or of a server. name: of what the page shows to tests."""
        self.page = browser.new_page(
            viewport={"width": width, "height": 900}, reduced_motion="reduce", color_scheme=scheme
        )
        self.address = address if isinstance(address, str) else address.as_uri()
        self.wrong: list[str] = []
        self.asked: list[str] = []
        self.page.on("pageerror", lambda error: self.wrong.append(str(error)))
        self.page.on(
            "console", lambda said: self.wrong.append(said.text) if said.type in ("error", "warning") else None
        )
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.page.goto(self.address + fragment)
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
        """Whatever happened, nothing went wrong and nothing was loaded besides the page."""
        assert self.wrong == []
        assert [url.partition("#")[0] for url in self.asked] == [self.address]
        self.page.close()
