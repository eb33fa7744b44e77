"""Views of messages as rows of tables: nested fields become columns, and undeclared ones JSON text."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator
from itertools import chain, count
from typing import Any, NamedTuple

import msgspec

from run_log.exporting.table import TIMES, Batch, Column, Kind, Table, Writer
from run_log.views.channel import VIEW, Channel, Json, Shown

ROWS = 8192
"""Number of rows of a table that are written together."""
LONGEST_STEM = 120
CLOCKS = {("plant/state", "t"): "plant_time", ("controller/tick", "t"): "loop_time"}
"""Names of time columns with their clock, by table and field."""
KINDS: dict[str, Kind] = {"number": "number", "integer": "integer", "boolean": "boolean", "string": "string"}


class Tables:
    """All tables of one log; passes their rows to the writers in batches.

    Args:
        writers: the formats to write.
    """

    def __init__(self, writers: list[Writer]):
        self._writers = writers
        self._of: dict[str, _Rows] = {}
        self.rows: dict[str, int] = {}
        """Number of rows written so far, by the name of the table."""

    def add(self, shown: Shown, log_time: int, since_start: float) -> None:
        """Add a row. Raises `OSError` if it cannot be written."""
        topic = shown.channel.topic
        rows = self._of.get(topic)
        if rows is None:
            name = topic.removeprefix(VIEW)
            taken = {other.stem for other in self._of.values()}
            rows = self._of[topic] = _Rows(name, _unlike(_stem(name), taken))
        rows.add(shown, log_time, since_start)
        if len(rows.batch) >= ROWS:
            self._write(rows)

    def finish(self) -> None:
        """Write the remaining rows. Raises `OSError`."""
        for rows in self._of.values():
            self._write(rows)

    def _write(self, rows: _Rows) -> None:
        table, batch = rows.take()
        if not batch:
            return
        self.rows[table.name] = self.rows.get(table.name, 0) + len(batch)
        for writer in self._writers:
            writer.write(table, batch)


class _Field(NamedTuple):
    """Path to the value of a column in a view."""

    path: tuple[str, ...]
    column: Column


class _Rows:
    """One table: its columns, and the rows that are not written yet."""

    def __init__(self, name: str, stem: str):
        self._name, self.stem = name, stem
        self._channel: Channel | None = None
        self._fields: dict[tuple[str, ...], _Field] = {}
        self.batch: Batch = []

    def add(self, shown: Shown, log_time: int, since_start: float) -> None:
        if shown.channel is not self._channel:
            self._channel = shown.channel
            for path, one in _leaves(shown.channel.schema, ()):
                if path not in self._fields:
                    taken = {column.name for column in TIMES} | {f.column.name for f in self._fields.values()}
                    self._fields[path] = _field(self._name, path, one, taken)
        values = msgspec.json.decode(shown.data)
        self.batch.append(
            [log_time, since_start, *(_value(values, field) for field in self._fields.values())]
        )

    def take(self) -> tuple[Table, Batch]:
        """Return the table and its waiting rows, and forget these rows."""
        batch, self.batch = self.batch, []
        table = Table(self._name, self.stem, (*TIMES, *(field.column for field in self._fields.values())))
        for row in batch:
            # Columns that the table does not have yet.
            row += [None] * (len(table.columns) - len(row))
        return table, batch


def _leaves(schema: Json, path: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], Json]]:
    for name, one in schema["properties"].items():
        if "properties" in one:  # none, where what has none yet is an object of counters
            yield from _leaves(one, (*path, name))
        else:
            yield (*path, name), one


def _field(table: str, path: tuple[str, ...], schema: Json, taken: set[str]) -> _Field:
    name = ".".join(path)
    items = schema.get("items", {})
    unit = schema.get("unit") or items.get("unit", "")
    return _Field(path, Column(_unlike(CLOCKS.get((table, name), name), taken), _kind(schema, items), unit))


def _kind(schema: Json, items: Json) -> Kind:
    if "oneOf" in schema:  # the level of foxglove.Log, one of several constants
        return "integer"
    if schema["type"] == "array" and items.get("type") == "number":
        return "numbers"
    return KINDS.get(schema["type"], "json")


def _value(values: Any, field: _Field) -> Any:
    for name in field.path:
        if not isinstance(values, dict):
            return None
        values = values.get(name)
    if values is None:
        return None
    match field.column.kind:
        case "number":
            return float(values)
        case "numbers":
            return [float(value) for value in values]
        case "json":
            return msgspec.json.encode(values).decode()
    return values


def _stem(name: str) -> str:
    """Return a name that every file system accepts; user topics may have any name."""
    return re.sub(r"[^a-z0-9_-]+", ".", name.lower()).strip(".")[:LONGEST_STEM] or "table"


def _unlike(name: str, taken: Collection[str]) -> str:
    """Return the name, with a number after it if it is in use."""
    candidates = chain([name], (f"{name}_{i}" for i in count(2)))
    return next(found for found in candidates if found not in taken)
