"""Makes foreign text safe for a terminal: no character moves the cursor, sets a colour or reverses the text."""

from __future__ import annotations

import re

# Control characters except tab and newline, invisible line ends and changes of direction, and surrogates, which stand
# for bytes of a file name that is not UTF-8.
_UNSEEN = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ufeff\ud800-\udfff]"
)


def printable(text: str) -> str:
    """Return text with each such character as its number, such as `\\u001b` for ESC."""
    return _UNSEEN.sub(lambda found: f"\\u{ord(found[0]):04x}", text)
