"""Views of user topics: JSON, msgpack or text without a schema.

The schema of such a channel follows from its messages. A field is declared with its kind when it first appears. A later
value of another kind is left out of the view. The log contains the bytes of every message.
"""

from __future__ import annotations

import contextlib
import json
import math
from typing import Any

import msgpack
import msgspec

from run_log.views.channel import (
    MOST_SCHEMAS,
    Channel,
    Json,
    Shown,
    array_schema,
    document,
    leaf,
    object_schema,
)

MOST_LEAVES = 256
"""Largest number of declared numbers, texts and arrays of one topic."""
MOST_ENTRIES = 256
"""Largest number of entries of an array that are shown."""
DEEPEST = 8
"""Largest depth of nested objects."""
LONGEST_TEXT = 1000
LONGEST_NAME = 100
LARGEST_WHOLE = 2**53
"""Largest integer that every JSON reader represents exactly."""


class UserView:
    """View of one user topic."""

    def __init__(self, name: str):
        """name: the key below `tandem/<plant>/`: "user/wind"."""
        self._name = name
        self._root = _Object()
        self._grown = 0
        self.channel: Channel | None = None
        """The channel with its present schema; None before the first message."""

    def render(self, payload: bytes) -> Shown | None:
        """Return the view of a message with any bytes; None if it is empty."""
        content = read(payload)
        values = content if isinstance(content, dict) else {"value": content}
        new = Room(self._root.leaves) if self._grown < MOST_SCHEMAS else Room(MOST_LEAVES)
        shown = self._root.take(values, new, DEEPEST)
        if not shown:
            return None
        if new.used or self.channel is None:
            self._grown += 1
            title = f"{self._name} (a user's topic, as seen so far)"
            self.channel = Channel(self._name, document(title, self._root.properties(), ()))
        return Shown(self.channel, msgspec.json.encode(shown))


def read(payload: bytes) -> Any:
    """Return the content as JSON, a msgpack map or array, a text, any other msgpack, or a description."""
    text: str | None = None
    with contextlib.suppress(ValueError, RecursionError):
        text = payload.decode()
        return json.loads(text)
    packed: Any = None
    with contextlib.suppress(ValueError, msgpack.UnpackException, RecursionError, TypeError, OverflowError):
        packed = msgpack.unpackb(payload, strict_map_key=False, timestamp=1, unicode_errors="replace")
    if isinstance(packed, dict | list):
        return packed
    if text is not None and all(one.isprintable() or one.isspace() for one in text[:LONGEST_TEXT]):
        return text
    return _bytes(payload) if packed is None else packed


def _text(text: str) -> str:
    # Half of a surrogate pair is invalid Unicode, and msgspec refuses it.
    return text.encode(errors="replace").decode()


def _bytes(data: bytes) -> str:
    return f"{len(data)} bytes"


class Room:
    """Counts the further leaves that may be declared."""

    def __init__(self, taken: int):
        self._free, self.used = MOST_LEAVES - taken, 0

    def take(self) -> bool:
        if self.used >= self._free:
            return False
        self.used += 1
        return True


class _Object:
    """The declared fields of an object."""

    def __init__(self) -> None:
        self._fields: dict[str, str | _Object] = {}
        """By name: "number", "string", "boolean", "numbers", or the fields of an object."""

    @property
    def leaves(self) -> int:
        return sum(one.leaves if isinstance(one, _Object) else 1 for one in self._fields.values())

    def properties(self) -> Json:
        return {name: _schema(one) for name, one in self._fields.items()}

    def take(self, values: dict[Any, Any], new: Room, deep: int) -> Json:
        """Declare new fields within the limits, and return the declared values."""
        shown: Json = {}
        for key, value in values.items():
            name = _text(str(key)[:LONGEST_NAME])
            kind, value = _plain(value)
            known = self._fields.get(name)
            if isinstance(value, dict):
                inner = known if isinstance(known, _Object) else None
                if inner is None and (known is not None or deep <= 1):
                    continue
                inner = inner or _Object()
                if found := inner.take(value, new, deep - 1):
                    self._fields[name] = inner
                    shown[name] = found
            elif kind and (known == kind or (known is None and new.take())):
                self._fields[name] = kind
                shown[name] = value
        return shown


def _schema(field: str | _Object) -> Json:
    if isinstance(field, _Object):
        return object_schema(field.properties())
    return array_schema(leaf("number")) if field == "numbers" else leaf(field)


def _plain(value: Any) -> tuple[str, Any]:
    """Return the kind of a leaf and its value. An object has no kind; "" means that there is nothing to show."""
    if isinstance(value, bool):
        return "boolean", value
    if isinstance(value, int):
        if abs(value) <= LARGEST_WHOLE:
            return "number", value
        try:
            return "number", float(value)
        except OverflowError:
            return "", None
    if isinstance(value, float):
        return ("number", value) if math.isfinite(value) else ("", None)
    if isinstance(value, str):
        return "string", _text(value[:LONGEST_TEXT])
    if isinstance(value, bytes):
        return "string", _bytes(value)
    if isinstance(value, msgpack.ExtType):
        return "string", _bytes(value.data)
    if isinstance(value, dict):
        return "", value
    if isinstance(value, list):
        entries = [_plain(one) for one in value[:MOST_ENTRIES]]
        if entries and all(kind == "number" for kind, _ in entries):
            return "numbers", [one for _, one in entries]
        return "", {f"item_{i}": one for i, one in enumerate(value[:MOST_ENTRIES])}
    return "", None
