"""What a user can mend: one sentence that names the thing and the mend, exit code 2, no traceback."""

import re

_FULL = re.compile(r"out of memory[^\n]*|bad_alloc|RESOURCE_EXHAUSTED: ?([^\n]*)", re.IGNORECASE)
"""What JAX, XLA's CPU and GPU runtimes and C++ say of a memory that is full."""

_MISSING = re.compile(r"Unable to initialize backend [^\n]*?(?= \(set JAX_PLATFORMS|\n|$)")
"""What JAX says of a platform that was asked for and is not there."""


class UserError(Exception):
    """Something the user asked for cannot be done."""


def reason(error: OSError) -> str:
    """Return the operating system's words for what went wrong, without numbers and tracebacks."""
    return error.strerror or str(error)


def full_memory(error: BaseException) -> str | None:
    """Return the words of an error that is about a full memory; None for any other error."""
    if isinstance(error, MemoryError):
        return str(error).rstrip(" .") or "out of memory"
    found = _FULL.search(str(error)) if isinstance(error, RuntimeError) else None
    return None if found is None else (found[1] or found[0]).rstrip(" .")


def missing_device(error: BaseException) -> str | None:
    """Return the words of an error that is about a device that JAX cannot start; None for any other error."""
    found = _MISSING.search(str(error)) if isinstance(error, RuntimeError) else None
    return None if found is None else found[0].rstrip(" .")


class ConfigError(UserError, ValueError):
    """A setting that cannot be: one sentence that names the thing and the mend."""


class Faulty(UserError):
    """A task has given what it must not: a number that is not finite, another shape, an error of its own."""
