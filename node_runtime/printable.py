"""Text from elsewhere as text: on a terminal nothing in it moves the cursor, sets a colour or turns a line around."""

from __future__ import annotations

import re

# Control characters but tab and end of line; what ends lines or changes their direction unseen; halves of characters,
# which stand for the bytes of a file's name that is not UTF-8.
_UNSEEN = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ufeff\ud800-\udfff]"
)


def printable(text: str) -> str:
    """The same with each such character as its number, ESC as `\\u001b`: for whatever a person reads."""
    return _UNSEEN.sub(lambda found: f"\\u{ord(found[0]):04x}", text)
