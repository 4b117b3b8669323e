"""Plain letters for those that an encoding has not: 3 +/- 1 instead of 3 ± 1."""

import codecs
import unicodedata
from typing import Any

PLAIN_LETTERS = "gacrl-plain-letters"
"""The name under which `str.encode` knows it, as it knows `replace`."""

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


def in_letters_of(encoding: str, text: str) -> str:
    """Return the text as a stream of this encoding shows it."""
    return text.encode(encoding, PLAIN_LETTERS).decode(encoding, "surrogateescape")


def _replaced(error: UnicodeError) -> tuple[Any, int]:
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


codecs.register_error(PLAIN_LETTERS, _replaced)
