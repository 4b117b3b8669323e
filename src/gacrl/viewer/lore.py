"""What a page is told once somebody has had time to count it: yardsticks, and what the words go with."""

import time
from typing import Any

from gacrl.export.html import HEARD, heard
from gacrl.export.yardsticks import EPISODES, yardsticks
from gacrl.viewer.cast import Cast, Player
from gacrl.viewer.server import Board

_CELLS = 20_000_000
"""Of the graphs of all recorded episodes together: large teams are heard in fewer of them."""
_AGAIN = 300.0
"""Seconds between two countings of a policy that is being trained."""
_EVERY = 5.0


def keep_telling(cast: Cast, board: Board) -> None:
    """Put yardsticks on the board, then the dictionary of the first policy, and a new one for newer parameters."""
    player = cast.players[0]
    if player.task.make(player.settings).hosted:
        return  # Python would play for minutes, and nobody knows where things are
    board.put("known", yardsticks=_yardsticks(player))
    counted: Any = None
    while player.opened is not None:
        if player.opened is not counted:
            counted = player.opened
            found = heard(counted, _share(player, HEARD), player.sampled)
            if not found:
                return  # it says nothing in symbols
            board.put("words", **found)
            time.sleep(_AGAIN)
        time.sleep(_EVERY)


def _yardsticks(player: Player) -> dict[str, Any]:
    """Of the task with as many agents as it has by itself: the page shows them there alone."""
    env, params = player.task.make(player.settings), player.params(player.home, player.home)
    return yardsticks(player.task, env, params, player.measures, _share(player, EPISODES))


def _share(player: Player, episodes: int) -> int:
    """Return so many episodes, or as many as large teams leave room for."""
    steps = player.task.make(player.settings).max_cycles
    return max(8, min(episodes, _CELLS // (player.home**2 * steps)))
