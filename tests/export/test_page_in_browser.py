"""The exported page in a real browser, opened from disk: it plays, listens to hands, and shows what is done to words."""

import importlib.util
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browsing import Visit

from gacrl import play
from gacrl.export.html import MOST_BYTES

ROOT = Path(__file__).parents[2]
PAGES = {path.stem: path for path in (ROOT / "docs" / "pages").glob("*.html")}
TALKS, TEAM, SEEN = PAGES["gacrl-reference"], PAGES["gacrl-teams"], PAGES["gacrl-traffic"]

MOMENT = """step => {
  const { session, act } = gacrlPage;
  act.seek(step); session.work(step);
  const lane = (it) => it.frames[step] && {...it.frames[step].totals, share: it.frames[step].share,
    positions: [...it.frames[step].state.positions], landmarks: [...it.frames[step].state.landmarks],
    goals: [...(it.frames[step].state.goals ?? [])],
    said: it.frames[step].decision.said, arrived: it.frames[step].decision.arrived, hears: it.frames[step].decision.hears};
  return {main: lane(session.main), twin: session.meddled ? lane(session.twin) : null};
}"""
POINT = """([thing, index]) => {
  const { view, session, still } = gacrlPage, frame = session.main.frames[Math.floor(still.t)];
  const box = view.canvas.getBoundingClientRect();
  const [x, y] = thing === "word" ? [view.words[index].x, view.words[index].y]
    : view.place(frame.scene[thing][index].x, frame.scene[thing][index].y);
  return [box.left + (x / view.size) * box.width, box.top + (y / view.size) * box.height];
}"""


def at(visit: Visit, step: int) -> Any:
    """Go to a step; what the page knows there, in both lanes."""
    return visit(MOMENT, step)


def point_at(visit: Visit, thing: str, index: int) -> None:
    """Move the pointer over a thing in the picture."""
    visit("new Promise(requestAnimationFrame)")  # it is where it was drawn
    visit.page.mouse.move(*visit(POINT, [thing, index]))


def away(moment: dict[str, Any]) -> float:
    """How far the nearest agent is from landmark 0."""
    agents = np.reshape(moment["positions"], (-1, 2))
    return float(np.hypot(*(agents - moment["landmarks"][:2]).T).min())


def test_the_pages_of_the_documents_are_those_of_the_policies_and_modules_of_now():
    spec = importlib.util.spec_from_file_location("pages", ROOT / "benchmarks" / "pages.py")
    assert spec is not None and spec.loader is not None
    pages = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(pages)
    assert set(PAGES) == set(play.pretrained())
    guide = (ROOT / "docs" / "guides" / "page.md").read_text(encoding="utf-8")
    for name, path in PAGES.items():
        text = path.read_text(encoding="utf-8")
        assert pages.dressed(text) == text, f"`python benchmarks/pages.py` makes {name} anew"
        assert path.stat().st_size <= MOST_BYTES and f"(../pages/{name}.html)" in guide


def test_it_plays_and_one_silenced_agent_costs_the_other_its_goal(browser: Any):
    visit = Visit(browser, TALKS)
    page = visit.page
    visit.press(" ")
    visit.until("gacrlPage.still.t > 3")
    visit.press(" ")
    assert not page.locator("#right").is_visible()
    page.get_by_role("button", name="Silence agent 0").click()
    lost: list[float] = []
    for _ in range(6):
        page.get_by_role("button", name="Rewind").click()
        both = at(visit, 25)
        lost.append(both["main"]["return"] - both["twin"]["return"])
        assert both["twin"]["share"] == 1.0
        page.get_by_role("button", name="New start").click()
    assert sum(lost) / len(lost) < -3
    page.get_by_role("button", name="Rewind").click()
    at(visit, 20)
    assert page.locator("#right").is_visible()
    visit.until("document.getElementById('verdict').textContent.startsWith('Agent 0 is silenced')")
    visit.close()


@pytest.mark.parametrize(
    ("chosen", "verdict"),
    [("swap", "swapped"), ("scramble", "scrambled"), ("delay", "late"), ("drop", "half lost")],
)
def test_what_is_chosen_happens_to_the_words_and_nothing_to_the_untouched_run(
    browser: Any, chosen: str, verdict: str
):
    visit = Visit(browser, TALKS, "#seed=4&n=2&at=0")
    before = [at(visit, t)["main"] for t in range(12)]
    visit.page.get_by_label("How the words of agent 0 arrive").select_option(chosen)
    visit.page.get_by_role("button", name="Rewind").click()
    steps = [at(visit, t) for t in range(12)]
    lanes = [step["main"] for step in steps]
    assert [step["twin"] for step in steps] == before
    said, arrived = (
        np.array([[words[0] for words in lane[kind]] for lane in lanes]) for kind in ("said", "arrived")
    )
    heard = np.array([0 in lane["hears"][1] for lane in lanes])
    if chosen == "swap":
        assert [words[0] for words in lanes[0]["arrived"]] == [words[1] for words in lanes[0]["said"]]
        assert [words[1] for words in lanes[0]["arrived"]] == [words[0] for words in lanes[0]["said"]]
    elif chosen == "scramble":
        assert (said != arrived).any() and heard.all()
    elif chosen == "delay":
        assert (arrived[3:] == said[:-3]).all() and heard.tolist() == [False] * 3 + [True] * 9
    else:
        assert 0 < heard.sum() < 12 and (said == arrived).all()
    assert all(0 in step["main"]["hears"][1] or chosen in ("delay", "drop") for step in steps)
    visit.until(f"document.getElementById('verdict').textContent.includes('{verdict}')")
    visit.close()


def test_who_takes_a_voice_leads_the_other_to_another_goal(browser: Any):
    """The words that meant another landmark in another start lead there in this one."""
    visit = Visit(browser, TALKS, "#seed=3&n=2&at=0")
    starts: dict[int, list[int]] = {}
    for _ in range(12):  # what agent 0 says of each goal that agent 1 may have
        first = at(visit, 0)["main"]
        starts.setdefault(first["goals"][1], [round_[0] for round_ in first["said"]])
        visit.page.get_by_role("button", name="New start").click()
    own = at(visit, 0)["main"]["goals"][1]
    other = next(goal for goal in starts if goal != own)
    visit.page.get_by_label("How the words of agent 0 arrive").select_option("speak")
    for number, word in enumerate(starts[other]):
        visit.page.get_by_label(f"Your word of round {number + 1} for agent 0").select_option(str(word))
    visit.page.get_by_role("button", name="Rewind").click()
    end = at(visit, 25)
    landmarks = np.reshape(end["main"]["landmarks"], (-1, 2))
    led, untouched = (np.array(end[lane]["positions"][2:]) for lane in ("main", "twin"))
    assert np.hypot(*(led - landmarks[other])) < 0.15 and np.hypot(*(untouched - landmarks[own])) < 0.15
    visit.close()


def test_dragged_landmarks_are_followed(browser: Any):
    visit = Visit(browser, TEAM, "#seed=1&n=5&at=0")
    before = at(visit, 20)["main"]
    point_at(visit, "marks", 0)
    box = visit.page.locator("#scene").bounding_box()
    visit.page.mouse.down()
    visit.page.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 0.5 * box["height"], steps=4)
    visit.page.mouse.up()
    moved, followed = at(visit, 20)["main"], at(visit, 60)["main"]
    assert away(before) < 0.1 and away(moved) > 0.4
    assert away(followed) < 0.15, "somebody has come after the landmark"
    visit.close()


def test_agents_are_added_to_thirty_and_to_a_hundred_and_play_without_a_stutter(browser: Any):
    visit = Visit(browser, TEAM, "#seed=1&n=5&at=0")
    page = visit.page
    for _ in range(25):
        page.get_by_role("button", name="+ agent").click()
    page.get_by_role("button", name="Rewind").click()
    crowd = at(visit, 75)["main"]
    assert len(crowd["positions"]) == 60 and crowd["share"] > 0.6
    visit.close()

    visit = Visit(browser, TEAM, "#seed=1&n=99&at=0")
    page = visit.page
    page.get_by_role("button", name="+ agent").click()
    visit.until("document.getElementById('count').textContent === '100 agents'")
    assert page.get_by_role("button", name="+ agent").is_disabled()
    watched = page.context.new_cdp_session(page)
    watched.send("Performance.enable", {"timeDomain": "threadTicks"})

    def busy() -> float:
        return next(
            it["value"] for it in watched.send("Performance.getMetrics")["metrics"] if it["name"] == "TaskDuration"
        )

    visit.press(" ")
    before = busy()
    visit(
        "new Promise(done => { let left = 60; (function tick() { left-- ? requestAnimationFrame(tick) : done(); })(); })"
    )
    each = (busy() - before) / 60
    assert each < 1 / 60, f"{1000 * each:.1f} ms of the processor a frame leave no room for 60 of them a second"
    assert visit("gacrlPage.session.main.frames[0].scene.agents.length") == 100
    visit.close()


def test_a_radius_and_a_cut_edge_are_not_heard_across(browser: Any):
    visit = Visit(browser, TEAM, "#seed=2&n=4&at=0")
    hearers = at(visit, 0)["main"]["hears"]
    assert any(hearers)
    one = next(i for i, speakers in enumerate(hearers) if speakers)
    other = hearers[one][0]
    visit.page.get_by_label("One agent").select_option(str(one))
    visit.page.get_by_label("Other agent").select_option(str(other))
    visit.page.get_by_role("button", name="Cut").click()
    cut = at(visit, 0)
    assert other not in cut["main"]["hears"][one] and one not in cut["main"]["hears"][other]
    assert cut["twin"]["hears"] == hearers
    visit.page.get_by_role("button", name="Mend").click()
    assert at(visit, 0)["main"]["hears"] == hearers
    visit.focus("radius")
    visit.press("Home")
    # It is drawn with the next frame.
    visit.page.wait_for_function("document.querySelector('#radius-value').innerText === '0.0'")
    assert at(visit, 0)["main"]["hears"] == [[]] * 4
    visit.close()


def test_the_pointer_over_an_agent_or_a_word_tells_about_it(browser: Any):
    visit = Visit(browser, TALKS, "#seed=4&n=2&at=5")
    point_at(visit, "agents", 1)
    visit.until("document.getElementById('about-name').textContent === 'Agent 1'")
    told = visit.page.locator("#about").inner_text()
    for part in ("Sees", "Hears", "Says", "Next", "Means", "What each action looks worth"):
        assert part in told
    assert not visit.page.locator("#word").is_visible()
    spoken = visit("gacrlPage.view.words.findIndex(word => word.index === 0 && word.round === 0)")
    point_at(visit, "word", spoken)
    said = visit.page.locator("#word").inner_text()
    letter = visit("gacrlPage.session.main.frames[5].decision.said[0][0]")
    assert (
        said.startswith(f"{chr(65 + letter)} in round 1: ") and "agent 0" in said and "the next action is" in said
    )
    visit.page.mouse.move(5, 5)
    assert not visit.page.locator("#word").is_visible()
    visit.close()


def test_scrubbing_and_rewinding_show_the_same_again(browser: Any):
    visit = Visit(browser, TALKS, "#seed=6&n=2&at=0")
    once = [at(visit, t) for t in (3, 11, 25)]
    visit.focus("scrub")
    visit.press("Home", "ArrowRight", "ArrowRight", "ArrowRight")
    assert visit("gacrlPage.still.t") == 3 and at(visit, 3) == once[0]
    visit.page.get_by_role("button", name="New start").click()
    assert at(visit, 3) != once[0]
    visit("gacrlPage.session.restart(0, 6)")
    visit.page.get_by_role("button", name="Rewind").click()
    assert visit("gacrlPage.still.t") == 0 and [at(visit, t) for t in (3, 11, 25)] == once
    visit.close()


FOCUSED = """() => {
  const it = document.activeElement, { outlineStyle, outlineWidth } = getComputedStyle(it);
  return [it.id || it.dataset.key || it.textContent, outlineStyle, parseFloat(outlineWidth)];
}"""
REACHABLE = """() => [...document.querySelectorAll("button, select, input, canvas[tabindex], summary")]
  .filter(it => it.checkVisibility() && !it.disabled).map(it => it.id || it.dataset.key || it.textContent)"""


def test_every_control_is_reached_without_a_pointer_and_shows_its_focus(browser: Any):
    for path, fragment in ((TALKS, "#seed=3&n=2&at=4&do=0:voice:0:speak:1:2"), (SEEN, "#seed=1&n=5&at=4")):
        visit = Visit(browser, path, fragment)
        wanted, seen = visit(REACHABLE), dict[str, tuple[str, float]]()
        for _ in range(len(wanted) + 3):  # also what scrolls has the focus in its turn
            visit.press("Tab")
            name, style, width = visit(FOCUSED)
            seen[name] = (style, width)
        assert set(seen) >= set(wanted) and len(wanted) > 10
        assert all(seen[name][0] == "solid" and seen[name][1] >= 2 for name in wanted)
        visit.close()


def test_every_key_does_what_the_page_says(browser: Any):
    visit = Visit(browser, TEAM, "#seed=3&n=4&at=0")
    still = "JSON.stringify([gacrlPage.still.t, gacrlPage.still.playing, gacrlPage.still.speed])"
    visit.press(".", ".", ",")
    assert visit(still) == "[1,false,5]"
    visit.press("]", "]", "[", " ")
    assert visit(still).endswith("true,10]")
    visit.press(" ", "r")
    assert visit(still) == "[0,false,10]"
    visit.press("n", "+", "+", "-")
    assert visit("[gacrlPage.session.start.seed, gacrlPage.session.standing(0).count]") == [4, 5]
    visit.press("a", "a", "s")
    assert visit("Object.keys(gacrlPage.session.standing(0).fates)") == ["1"]
    visit.press("S")
    assert visit("Object.values(gacrlPage.session.standing(0).fates).map(it => it.kind)") == ["silence"] * 5
    visit.press("S", "m")
    before = at(visit, 0)["main"]["landmarks"]
    visit.focus("scene")
    visit.press("ArrowRight", "ArrowRight", "ArrowUp")
    moved = np.subtract(at(visit, 0)["main"]["landmarks"], before)
    np.testing.assert_allclose(moved[:2], [0.1, 0.05], atol=1e-9)
    assert not moved[2:].any() and visit("gacrlPage.session.standing(0).fates") == {}
    visit.close()


def test_a_link_shows_the_same_scene_and_nonsense_in_it_does_no_harm(browser: Any):
    visit = Visit(browser, TALKS, "#seed=9&n=2&at=7&do=2:voice:0:speak:3:1,4:move:mark:1:0.5:-0.25")
    first = at(visit, 12)
    visit("gacrlPage.act.copy()")
    fragment = "#" + visit.page.url.partition("#")[2]
    assert "voice:0:speak:3:1" in fragment and "at=12" in fragment
    visit.close()
    again = Visit(browser, TALKS, fragment)
    assert at(again, 12) == first
    again.close()
    odd = "#seed=1e99&n=NaN&at=-4&do=3:voice:7:silence,<img src=x onerror=alert(1)>,1:move:mark:0:Infinity:0,2:add,0:radius:-1"
    lost = Visit(browser, TALKS, odd)
    assert lost("gacrlPage.session.events") == []
    lost.close()


def test_recorded_episodes_play_under_the_same_controls(browser: Any):
    visit = Visit(browser, SEEN, "#seed=1&n=5&at=0")
    visit.press("S")
    visit.focus("scrub")
    visit.press("End")
    visit.until("document.getElementById('verdict').textContent.includes('worse than untouched')")
    assert visit("gacrlPage.session.main.frames[20].decision.hears.flat()") == []
    visit.press("Home")
    visit("gacrlPage.act.silence(true)")
    visit.until("document.getElementById('right').hidden")
    visit.close()


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_it_is_readable_on_a_phone(browser: Any, scheme: str):
    visit = Visit(browser, TALKS, "#seed=1&n=2&at=8&do=0:voice:0:silence", width=390)
    visit.page.emulate_media(color_scheme=scheme)
    assert visit("document.documentElement.scrollWidth") <= 390
    colours = visit("(({color, backgroundColor}) => [color, backgroundColor])(getComputedStyle(document.body))")
    light = [sum(map(int, re.findall(r"\d+", colour)[:3])) for colour in colours]
    assert abs(light[0] - light[1]) > 450, "ink stands out from paper"
    visit.close()
