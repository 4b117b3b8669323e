"""How long the exported page takes for a frame, in a headless Chromium (`playwright`, and the system's browser).

    python benchmarks/page_frames.py [AGENTS …]     5 30 100 without any

Of docs/pages/gacrl-teams.html, playing, alone and beside the untouched run: the time between two frames (16.7 ms are
60 a second), and what the page's own thread computes in each of them, which other work on the machine hardly changes.
"""

import os
import sys
from pathlib import Path
from typing import Any

import chromium

PAGE = Path(__file__).parent.parent / "docs" / "pages" / "gacrl-teams.html"
FRAMES = 240
WATCH = """count => new Promise(done => {
  const between = []; let before = null;
  requestAnimationFrame(function tick(now) {
    if (before !== null) between.push(now - before);
    before = now;
    if (between.length < count) requestAnimationFrame(tick); else done(between.sort((a, b) => a - b));
  });
})"""


def main() -> None:
    """Print a line for each number of agents, alone and beside the untouched run."""
    print(f"{os.cpu_count()} processors, load {os.getloadavg()[0]:.1f}; milliseconds of {FRAMES} frames")
    with chromium.opened() as opened:
        print(f"Chromium {opened.version}")
        for agents in sys.argv[1:] or ("5", "30", "100"):
            page = opened.new_page(viewport={"width": 1200, "height": 900})
            page.goto(f"{PAGE.as_uri()}#seed=1&n={agents}&at=0")
            page.evaluate("gacrlPage.act.toggle()")
            print(f"{agents:>4} agents                  {frames(page)}")
            page.evaluate("gacrlPage.act.silence(true)")
            print(f"{agents:>4} agents, both pictures   {frames(page)}")
            page.close()


def frames(page: Any) -> str:
    """Watch some frames: the time between them, and what they take of the page's thread."""
    watched = page.context.new_cdp_session(page)
    watched.send("Performance.enable", {"timeDomain": "threadTicks"})

    def busy() -> float:
        found = watched.send("Performance.getMetrics")["metrics"]
        return next(it["value"] for it in found if it["name"] == "TaskDuration")

    before = busy()
    between = page.evaluate(WATCH, FRAMES)
    each = 1000 * (busy() - before) / FRAMES
    return (
        f"median {between[FRAMES // 2]:5.1f}   p95 {between[FRAMES * 95 // 100]:5.1f}   of its thread {each:5.1f}"
    )


if __name__ == "__main__":
    main()
