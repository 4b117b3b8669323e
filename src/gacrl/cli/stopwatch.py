"""Seconds since the command was typed, as a clock on the wall counts them."""

import os
import time
from pathlib import Path

_LONGEST_START = 30.0
"""A process that is older when its command begins did something else before, as a script that gave itself up for us."""
_begun = time.monotonic()


def begin(with_process: bool) -> None:
    """Begin to count: now, or when this process was started, where the system tells."""
    global _begun
    _begun = time.monotonic() - (_age_of_process() if with_process else 0.0)


def seconds() -> float:
    """Return the seconds since then."""
    return time.monotonic() - _begun


def _age_of_process() -> float:
    """Seconds that this process has run; 0 where the system does not tell (it is Linux that does)."""
    try:
        fields = Path("/proc/self/stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()
        started = int(fields[19]) / os.sysconf("SC_CLK_TCK")  # since the machine was
        age = time.clock_gettime(time.CLOCK_BOOTTIME) - started
    except (OSError, ValueError, IndexError, AttributeError):
        return 0.0
    return age if 0 <= age <= _LONGEST_START else 0.0
