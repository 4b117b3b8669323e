"""How much longer a run will take, judged by how long its parts have taken so far."""

import math

_SECONDS_A_FRAME = 0.006
"""Of a picture that is 480 pixels wide, on one core."""


def closing_seconds(playing: float, more_episodes: float, frames: int) -> float:
    """Return what is still to come after the last chunk; its programs are compiled by then.

    playing: seconds that the evaluations along the way take. more_episodes: how many times as many the closing
    evaluations have. frames: of all pictures.
    """
    return more_episodes * playing + _SECONDS_A_FRAME * frames


def seconds_left(
    env_steps: int, steps_per_second: float, evaluations: int, playing: float, closing: float
) -> float:
    """Sum chunks, the evaluations after them, and what closes it, in whole seconds; NaN where nothing was timed.

    env_steps: that all seeds have still to take. evaluations: that are still to come.
    """
    if not steps_per_second > 0:
        return math.nan
    return float(math.ceil(env_steps / steps_per_second + evaluations * playing + closing))
