"""An update of training, timed."""

import statistics
import time
from typing import Any


def timed(trainer: Any, run: Any, seconds: float) -> tuple[float, Any]:
    """CPU seconds of an update once learning has begun, the median of three measurements; and the state after them."""
    import jax

    warm = -(-getattr(run.algorithm, "learning_starts", 0) // run.steps_per_update) + 1
    state, _ = trainer.chunk(trainer.init((0,)), warm)

    def turn(updates: int) -> float:
        nonlocal state
        begun = time.process_time()
        state, report = trainer.chunk(state, updates)
        jax.block_until_ready(report)
        return (time.process_time() - begun) / updates

    updates = max(1, round(seconds / turn(1)))
    return statistics.median(turn(updates) for _ in range(3)), state
