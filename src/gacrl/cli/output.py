"""The output streams: whatever letters they can show, and whether or not anybody still reads them."""

import io
import sys
from typing import Any

from gacrl.report.letters import PLAIN_LETTERS


def warn(sentence: str) -> None:
    """Say a sentence where errors are told."""
    print(f"gacrl: {sentence}", file=sys.stderr)


def prepare() -> None:
    """Let standard output and error take every letter, and outlive whoever reads them.

    A letter that the stream's encoding has not is written in plain ones. What is printed after the reader has gone, as
    `head` does, goes nowhere, and the command does its work to the end.
    """
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if isinstance(stream, io.TextIOWrapper) and isinstance(_raw(stream), io.FileIO):
            stream.flush()
            file: Any = _Unread(stream.fileno(), "w", closefd=False)
            file = file if _raw(stream) is stream.buffer else io.BufferedWriter(file)  # the former with python -u
            setattr(
                sys,
                name,
                io.TextIOWrapper(
                    file,
                    stream.encoding,
                    PLAIN_LETTERS,
                    line_buffering=stream.line_buffering,
                    write_through=stream.write_through,
                ),
            )


def finish() -> None:
    """Write what is still held back. Raises OSError where some of it could not be written, as on a full disk."""
    if sys.stdout is None:
        return
    sys.stdout.flush()
    raw = _raw(sys.stdout) if isinstance(sys.stdout, io.TextIOWrapper) else None
    if isinstance(raw, _Unread) and raw.failed is not None:
        error, raw.failed = raw.failed, None
        raise OSError(error.errno, error.strerror, "standard output")


def _raw(stream: io.TextIOWrapper) -> Any:
    """The file under a stream and its buffer, where it has one."""
    return getattr(stream.buffer, "raw", stream.buffer)


class _Unread(io.FileIO):
    """A file that takes everything, also after its reader has gone: no work is lost for want of somebody who looks."""

    _gone = False
    failed: OSError | None = None
    """Why it could not be written, except that its reader has gone."""

    def write(self, data: Any, /) -> int:
        if not self._gone:
            try:
                return super().write(data)
            except BrokenPipeError:
                self._gone = True
            except OSError as error:
                self._gone, self.failed = True, error
        return memoryview(data).nbytes
