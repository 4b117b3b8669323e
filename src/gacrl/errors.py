"""What a user can mend: one sentence that names the thing and the mend, exit code 2, no traceback."""


class UserError(Exception):
    """Something the user asked for cannot be done."""


def reason(error: OSError) -> str:
    """The operating system's words for what went wrong, without numbers and tracebacks."""
    return error.strerror or str(error)


class ConfigError(UserError, ValueError):
    """A setting that cannot be: one sentence that names the thing and the mend."""
