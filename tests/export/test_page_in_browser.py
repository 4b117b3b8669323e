"""The exported page in a real browser, opened from disk: it plays, listens to hands, and shows what silence does."""

import importlib.util
import re
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gacrl.export import html, yardsticks
from gacrl.export.source import Source

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
PLAYWRIGHT = importlib.util.find_spec("playwright") is not None
pytestmark = pytest.mark.skipif(
    not CHROMIUM or not PLAYWRIGHT,
    reason="the exported page is looked at in Chromium by Playwright (apt-get install chromium; pip install playwright)",
)


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory, quick_start: Any) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("pages")
    found = {name: folder / f"{name}.html" for name in ("gacrl-reference", "gacrl-teams")}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(html, "HEARD", 20)
        patch.setattr(yardsticks, "EPISODES", 20)
        for name, path in found.items():
            html.write(Source(f"pretrained:{name}"), path)
    return found


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield browser
        browser.close()


class Visit:
    """A page in the browser; its errors and what it asks the network for are kept."""

    def __init__(self, browser: Any, path: Path, fragment: str = "", width: int = 1200):
        self.page = browser.new_page(viewport={"width": width, "height": 900}, reduced_motion="reduce")
        self.wrong: list[str] = []
        self.asked: list[str] = []
        self.page.on("pageerror", lambda error: self.wrong.append(str(error)))
        self.page.on(
            "console", lambda said: self.wrong.append(said.text) if said.type in ("error", "warning") else None
        )
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.page.goto(path.as_uri() + fragment)
        self.until("globalThis.gacrlPage !== undefined")

    def until(self, expression: str) -> None:
        """Wait for it. (Playwright's own waiting evaluates text, which the page's policy forbids.)"""
        deadline = time.monotonic() + 10
        while not self.page.evaluate(expression):
            assert time.monotonic() < deadline, expression
            time.sleep(0.05)

    def at(self, step: int) -> Any:
        """Go to a step and return what the page knows there."""
        return self.page.evaluate(
            """step => {
              const { session, act } = gacrlPage;
              act.seek(step); session.work(step);
              const lane = (it) => it.frames[step] && {...it.frames[step].totals, share: it.frames[step].share,
                positions: [...it.frames[step].state.positions], landmarks: [...it.frames[step].state.landmarks]};
              return {main: lane(session.main), twin: session.meddled ? lane(session.twin) : null};
            }""",
            step,
        )

    def close(self) -> None:
        """Whatever happened, nothing went wrong and nothing was loaded."""
        assert self.wrong == []
        assert [url for url in self.asked if not url.startswith("file:")] == [] and len(self.asked) == 1
        self.page.close()


def away(moment: dict[str, Any]) -> float:
    """How far the nearest agent is from landmark 0."""
    agents = np.reshape(moment["positions"], (-1, 2))
    return float(np.hypot(*(agents - moment["landmarks"][:2]).T).min())


def test_it_plays_and_a_silenced_agent_costs_the_other_its_goal(pages: dict[str, Path], browser: Any):
    visit = Visit(browser, pages["gacrl-reference"])
    page = visit.page
    page.keyboard.press(" ")
    visit.until("gacrlPage.still.t > 3")
    page.keyboard.press(" ")
    lost: list[float] = []
    for _ in range(6):
        assert not page.locator("#right").is_visible() or lost
        if not lost:
            page.get_by_role("button", name="Silence everyone").click()
        page.get_by_role("button", name="Rewind").click()
        both = visit.at(25)
        lost.append(both["main"]["return"] - both["twin"]["return"])
        assert both["twin"]["share"] == 1.0
        page.get_by_role("button", name="New start").click()
    assert sum(lost) / len(lost) < -5
    page.get_by_role("button", name="Rewind").click()
    visit.at(20)
    assert page.locator("#right").is_visible()
    visit.until("document.getElementById('verdict').textContent.includes('worse than untouched')")
    visit.close()


def test_dragged_landmarks_are_followed_and_thirty_agents_fit(pages: dict[str, Path], browser: Any):
    visit = Visit(browser, pages["gacrl-teams"], "#seed=1&n=5&at=0")
    page = visit.page
    before = visit.at(20)["main"]
    box = page.locator("#scene").bounding_box()
    place = page.evaluate(
        "gacrlPage.view.place(...gacrlPage.session.main.frames[20].state.landmarks.slice(0, 2)).map(x => x / gacrlPage.view.size)"
    )
    page.mouse.move(box["x"] + place[0] * box["width"], box["y"] + place[1] * box["height"])
    page.mouse.down()
    page.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 0.5 * box["height"], steps=4)
    page.mouse.up()
    moved, followed = visit.at(20)["main"], visit.at(60)["main"]
    assert away(before) < 0.1 and away(moved) > 0.4
    assert away(followed) < 0.15, "somebody has come after the landmark"
    for _ in range(25):
        page.get_by_role("button", name="+ agent").click()
    page.get_by_role("button", name="Rewind").click()
    crowd = visit.at(75)["main"]
    assert len(crowd["positions"]) == 60 and crowd["share"] > 0.6
    visit.close()


def test_a_link_shows_the_same_scene_and_nonsense_in_it_does_no_harm(pages: dict[str, Path], browser: Any):
    visit = Visit(
        browser, pages["gacrl-reference"], "#seed=9&n=2&at=7&do=2:voice:0:speak:3:1,4:move:mark:1:0.5:-0.25"
    )
    page = visit.page
    first = visit.at(12)
    page.evaluate("gacrlPage.act.copy()")
    fragment = "#" + page.url.partition("#")[2]
    assert "voice:0:speak:3:1" in fragment and "at=12" in fragment
    visit.close()
    again = Visit(browser, pages["gacrl-reference"], fragment)
    assert again.at(12) == first
    again.close()
    odd = "#seed=1e99&n=NaN&at=-4&do=3:voice:7:silence,<img src=x onerror=alert(1)>,1:move:mark:0:Infinity:0,2:add,0:radius:-1"
    lost = Visit(browser, pages["gacrl-reference"], odd)
    assert lost.page.evaluate("gacrlPage.session.events") == []
    lost.close()


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_it_is_readable_on_a_phone(pages: dict[str, Path], browser: Any, scheme: str):
    visit = Visit(browser, pages["gacrl-reference"], "#seed=1&n=2&at=8&do=0:voice:0:silence", width=390)
    visit.page.emulate_media(color_scheme=scheme)
    assert visit.page.evaluate("document.documentElement.scrollWidth") <= 390
    colours = visit.page.evaluate(
        "(({color, backgroundColor}) => [color, backgroundColor])(getComputedStyle(document.body))"
    )
    light = [sum(map(int, re.findall(r"\d+", colour)[:3])) for colour in colours]
    assert abs(light[0] - light[1]) > 450, "ink stands out from paper"
    visit.close()
