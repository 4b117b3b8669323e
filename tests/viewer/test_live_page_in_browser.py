"""The live page in a real browser: it plays, listens to hands, and stays on the page when the server is lost."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from browsing import Visit
from serving import Site, cast_of, serving


@pytest.fixture(scope="module")
def reference() -> Iterator[Site]:
    with serving(cast_of("pretrained:gacrl-reference")) as site:
        yield site


@pytest.fixture(scope="module")
def teams() -> Iterator[Site]:
    with serving(cast_of("pretrained:gacrl-teams")) as site:
        yield site


class LiveVisit(Visit):
    """A page whose frames come from a server."""

    def at(self, step: int) -> Any:
        """Go to a step and return what is shown there, once the server has played it."""
        self.page.evaluate("step => gacrlPage.act.seek(step)", step)
        self.until(f"gacrlPage.session.paced === null && gacrlPage.session.fresh > {step}")
        return self.page.evaluate(
            """step => {
              const { session } = gacrlPage;
              const lane = ({ frames }) => frames[step] && { ...frames[step].totals, share: frames[step].share,
                agents: frames[step].scene.agents.map((it) => [it.x, it.y]),
                marks: frames[step].scene.marks.filter((it) => it.there).map((it) => [it.x, it.y]) };
              return { main: lane(session.main), twin: session.meddled ? lane(session.twin) : null };
            }""",
            step,
        )


def away(moment: dict[str, Any]) -> float:
    """How far the nearest agent is from landmark 0."""
    return float(np.hypot(*(np.array(moment["agents"]) - moment["marks"][0]).T).min())


def test_it_plays_and_a_silenced_agent_costs_the_other_its_goal(reference: Site, browser: Any):
    visit = LiveVisit(browser, reference.url)
    page = visit.page
    page.keyboard.press(" ")
    visit.until("gacrlPage.still.t > 3")
    page.keyboard.press(" ")
    page.get_by_role("button", name="Silence agent 0").click()
    lost: list[float] = []
    for _ in range(4):
        page.get_by_role("button", name="Rewind").click()
        both = visit.at(25)
        lost.append(both["main"]["return"] - both["twin"]["return"])
        page.get_by_role("button", name="New start").click()
    assert sum(lost) / len(lost) < -2
    again = both["main"]
    page.get_by_role("button", name="Rewind").click()
    page.evaluate("gacrlPage.act.seek(0); gacrlPage.session.restart(0, gacrlPage.session.start.seed - 1)")
    assert visit.at(25)["main"] == again, "the same seed is the same episode"
    assert page.locator("#right").is_visible() and "silenced" in page.locator("#verdict").inner_text()
    visit.close()


def test_it_says_what_an_agent_sees_and_says_and_what_is_found_out_later(reference: Site, browser: Any):
    visit = LiveVisit(browser, reference.url, "#seed=3&n=2&at=9")
    said = visit.at(9) and visit("gacrlPage.session.main.frames[9].decision.said.map(round => round[1])")
    visit.press("a", "a")
    visit.until("document.getElementById('about-name').textContent === 'Agent 1'")
    about = visit.page.locator("#about").inner_text()
    for part in ("Sees", "Must reach", "agent 0 (100\u00a0% of its attention)", "Then looks at", "looks worth"):
        assert part in about
    assert f"{chr(65 + said[0])} (" in about and "Means" not in about
    assert visit.page.locator("#gauges tbody tr").count() == 1 and visit.page.locator("#dictionary").is_hidden()
    word = {"agent": 1, "round": 0, "symbol": said[0], "of": "heard", "share": 0.5, "goal": [2, 0.75]}
    word |= {"direction": [2, 0.5], "distance": 0.25, "action": [1, 0.4]}
    reference.board.put("words", dictionary=[word], heard=1000)
    reference.board.put(
        "known", yardsticks={"told": {"return": [-1.0 * t for t in range(25)], "share": [0.5] * 25}}
    )
    visit.until("document.getElementById('about').textContent.includes('Means')")
    assert (
        "go to purple square (75\u00a0%). That lies above (50\u00a0%), 0.25 away"
        in visit.page.locator("#about").inner_text()
    )
    assert "in 1,000 recorded episodes" in visit.page.locator("#heading").inner_text()
    assert visit.page.locator("#gauges tbody").inner_text().split()[-4:] == ["told", "-8.0", "50", "%"]
    reference.board.notes.clear()
    visit.close()


def test_dragged_landmarks_are_followed_and_thirty_agents_fit(teams: Site, browser: Any):
    visit = LiveVisit(browser, teams.url, "#seed=1&n=5&at=0")
    page = visit.page
    before = visit.at(20)["main"]
    box = page.locator("#scene").bounding_box()
    x, y = before["marks"][0]
    place = page.evaluate("([x, y]) => gacrlPage.view.place(x, y).map((it) => it / gacrlPage.view.size)", [x, y])
    page.mouse.move(box["x"] + place[0] * box["width"], box["y"] + place[1] * box["height"])
    page.mouse.down()
    page.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 0.5 * box["height"], steps=4)
    page.mouse.up()
    moved, followed = visit.at(20)["main"], visit.at(60)["main"]
    assert away(before) < 0.2 and away(moved) > 0.4
    assert away(followed) < 0.2, "somebody has come after the landmark"
    for _ in range(25):
        page.get_by_role("button", name="+ agent").click()
    assert len(visit.at(60)["main"]["agents"]) == 30
    page.get_by_role("button", name="Rewind").click()
    crowd = visit.at(75)["main"]
    assert len(crowd["agents"]) == len(crowd["marks"]) == 30 and crowd["share"] > 0.6
    visit.close()


def test_the_page_outlives_its_server(browser: Any):
    with serving(cast_of("pretrained:gacrl-reference")) as site:
        visit = LiveVisit(browser, site.url)
        assert visit.page.locator("#notice").is_hidden()
        visit.at(5)
    visit.until("!document.getElementById('notice').hidden")
    visit.page.keyboard.press("s")
    assert "does not answer" in visit.page.locator("#notice").inner_text()
    assert visit.page.locator("#step").inner_text() == "step 5 of 25"
    visit.page.close()


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_it_is_readable_on_a_phone(reference: Site, browser: Any, scheme: str):
    curves = {"label": "return", "steps": [10, 20, 30], "seeds": [[-30.0, -22.0, -20.5], [-29.0, -26.0, -21.0]]}
    reference.board.put("learning", **curves, playing=30)
    visit = LiveVisit(browser, reference.url, "#seed=1&n=2&at=8&do=0:voice:0:silence", width=390, scheme=scheme)
    visit.at(8)
    visit.until("document.getElementById('learning') !== null")
    assert visit.page.evaluate("document.documentElement.scrollWidth") <= 390
    assert "-20.50, -21.00 after 30 steps" in visit.page.locator("#learning-step").inner_text()
    visit.close()
