"""A channel of views: its name, and a JSON schema in which every field is declared."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cached_property
from typing import Any, NamedTuple

import msgspec

Json = dict[str, Any]
VIEW = "view/"
"""Prefix of the names of these channels."""
MOST_NAMES = 256
"""Fields of one object."""
MOST_SCHEMAS = 32
"""Schemas of one channel, one after the other."""


class Channel:
    """One channel with one schema. If a channel gets more fields, a new object with the same `topic` replaces it.

    Attributes:
        topic: "view/plant/state".
        schema_name: "tandem.view.plant.state", or the name of a schema that other tools know.
        schema: a JSON schema of type object. Leaves with a unit have it as "unit", and in their "description".
    """

    def __init__(self, name: str, schema: Json, schema_name: str | None = None):
        """name: name of the channel below `view/`."""
        self.topic = VIEW + name
        self.schema_name = schema_name or f"tandem.view.{name.replace('/', '.')}"
        self.schema = schema

    @cached_property
    def schema_text(self) -> bytes:
        """The schema as JSON text."""
        return msgspec.json.encode(self.schema)

    def __repr__(self) -> str:
        return f"Channel({self.topic!r})"


class Shown(NamedTuple):
    """One message of a channel."""

    channel: Channel
    data: bytes
    """JSON text that obeys the channel's schema."""


def document(title: str, properties: Json, required: Iterable[str]) -> Json:
    """The schema of a whole message."""
    head = {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": title}
    return head | object_schema(properties, required)


def object_schema(properties: Json, required: Iterable[str] = ()) -> Json:
    """Return the schema of an object that has no other fields than these."""
    return {
        "type": "object",
        "properties": properties,
        "required": list(required),
        "additionalProperties": False,
    }


def array_schema(items: Json) -> Json:
    return {"type": "array", "items": items}


def leaf(kind: str, description: str = "", unit: str = "") -> Json:
    """The schema of a number, an integer, a string or a boolean."""
    schema: Json = {"type": kind}
    if description or unit:
        schema["description"] = f"{description} [{unit}]".strip() if unit else description
    if unit:
        schema["unit"] = unit
    return schema


class Growing:
    """An object whose fields are not known in advance, such as counters. Each is declared when it first appears."""

    def __init__(self, kind: str, description: str):
        self._leaf = leaf(kind)
        self._description = description
        self._names: dict[str, None] = {}
        self._grown = 0

    def __bool__(self) -> bool:
        """Whether a field is declared."""
        return bool(self._names)

    @property
    def schema(self) -> Json:
        return object_schema(dict.fromkeys(self._names, self._leaf)) | {"description": self._description}

    def grow(self, values: Mapping[str, Any]) -> bool:
        """Declare new fields; return whether the schema has changed."""
        if values.keys() <= self._names.keys() or self._grown >= MOST_SCHEMAS:
            return False
        before = len(self._names)
        for name in values:
            if len(self._names) < MOST_NAMES:
                self._names.setdefault(name)
        self._grown += len(self._names) > before
        return len(self._names) > before

    def declared(self, values: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return the values whose fields are declared."""
        if values.keys() <= self._names.keys():
            return values
        return {name: value for name, value in values.items() if name in self._names}
