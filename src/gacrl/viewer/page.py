"""The page of a cast: the exported one, whose episodes come from this server."""

from pathlib import Path
from typing import Any

from gacrl.export import bundle
from gacrl.export.html import common
from gacrl.viewer.cast import Cast

_MADE_BY = (
    "Served by <code>gacrl view</code>: "
    "the policy itself plays, in the process that printed the address of this page."
)


def page(cast: Cast, host: str) -> str:
    """Return the page for browsers that call the server by this name: it may connect there alone."""
    texts = {"opening.js": bundle.source("served.js")}
    connects = (f"ws://{host}", f"wss://{host}")
    data = page_data(cast)
    return bundle.page(f"{data['title']} · gacrl view", data, texts, connects, _MADE_BY)


def page_data(cast: Cast) -> dict[str, Any]:
    """Return what the page must know before the first frame."""
    first, bounds = cast.players[0], cast.bounds
    names = [short(player.name) for player in cast.players]
    rivals = None if len(names) == 1 else {"main": names[0], "twin": names[1]}
    return {
        **common(cast.task, cast.settings, " and ".join(names)),
        "measures": first.measures,
        "world": {**first.world, "num_agents": first.home},
        "network": {
            "settings": {
                "communication": "some" if bounds.rounds else "none",
                "rounds": bounds.rounds,
                "vocabulary": bounds.vocabulary,
                "draws": first.draws,
            }
        },
        "facts": {
            "least": bounds.least,
            "most": bounds.most,
            "count": first.home,
            "length": bounds.length,
            "movable": bounds.movable,
            "radius": first.reach if bounds.reach else None,
            "names": rivals,
        },
    }


def short(name: str) -> str:
    """Return a policy's name without folders."""
    return Path(name).name.removeprefix("pretrained:")
