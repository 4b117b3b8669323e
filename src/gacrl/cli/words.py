"""The words of a command, as the shell gives them."""


class Words(list[str]):
    """The words of a command, without --env NAME and --use FILE; `task` is the name that --env gave."""

    task: str | None = None
