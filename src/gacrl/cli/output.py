"""The output streams: whatever letters they can show, and whether or not anybody still reads them."""

import codecs
import io
import sys
import unicodedata
from typing import Any

_PLAIN = {
    **dict.fromkeys("─━╌═—–−", "-"),
    **dict.fromkeys("│┃║", "|"),
    **dict.fromkeys("╭╮╰╯┌┐└┘├┤┬┴┼╵╷", "+"),
    **dict.fromkeys("“”„", '"'),
    **dict.fromkeys("‘’", "'"),
    "×": "x",
    "±": "+/-",
    "→": "->",
    "…": "...",
    "·": "*",
    "∞": "infinity",
    "ß": "ss",
}
_GREEK = ("GREEK SMALL LETTER ", "GREEK CAPITAL LETTER ")
_ERRORS = "gacrl-plain"


def prepare() -> None:
    """Let standard output and error take every letter, and outlive whoever reads them.

    A letter that the stream's encoding has not is written in plain ones. What is printed after the reader has gone, as
    `head` does, goes nowhere, and the command does its work to the end.
    """
    codecs.register_error(_ERRORS, _in_plain_letters)
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if isinstance(stream, io.TextIOWrapper) and isinstance(getattr(stream.buffer, "raw", None), io.FileIO):
            stream.flush()
            raw = io.BufferedWriter(_Unread(stream.fileno(), "w", closefd=False))
            lines = stream.line_buffering or stream.isatty()
            setattr(sys, name, io.TextIOWrapper(raw, stream.encoding, _ERRORS, line_buffering=lines))


class _Unread(io.FileIO):
    """A file that takes everything after its reader has gone. Another error is raised once."""

    _gone = False

    def write(self, data: Any, /) -> int:
        if not self._gone:
            try:
                return super().write(data)
            except BrokenPipeError:
                self._gone = True
            except OSError:
                self._gone = True
                raise
        return memoryview(data).nbytes


def _in_plain_letters(error: UnicodeError) -> tuple[Any, int]:
    """For `codecs`: plain letters in place of those that cannot be encoded; bytes of a file's name as they are."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    letters = error.object[error.start : error.end]
    if all("\udc80" <= letter <= "\udcff" for letter in letters):
        return bytes(ord(letter) - 0xDC00 for letter in letters), error.end
    return "".join(map(_plain, letters)), error.end


def _plain(letter: str) -> str:
    if letter in _PLAIN:
        return _PLAIN[letter]
    name = unicodedata.name(letter, "")
    for greek in _GREEK:
        if name.startswith(greek):
            return name.removeprefix(greek).partition(" ")[0].lower()
    return unicodedata.normalize("NFKD", letter).encode("ascii", "ignore").decode() or "?"
