"""What may stand inside a page of ours: data that cannot end their element, and scripts known by their digest."""

import base64
import hashlib
import json
from typing import Any


def digest(text: str) -> str:
    """Return what a content security policy calls a script or a style: `sha256-…`."""
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def embedded(data: Any) -> str:
    """Return data as JSON in which no text can end the element that it stands in.

    Raises ValueError for a number that is not finite.
    """
    plain = json.dumps(data, allow_nan=False, separators=(",", ":"))
    for mark in "<>&\u2028\u2029":
        plain = plain.replace(mark, f"\\u{ord(mark):04x}")
    return plain
