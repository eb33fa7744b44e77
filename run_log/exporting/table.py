"""A table of an exported log: flat columns with a kind and a unit, and rows in batches."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol

Kind = Literal["time", "number", "integer", "boolean", "string", "numbers", "json"]
"""time: integer nanoseconds; numbers: a list of them; json: any other list or object, as JSON text. The others are the
types of a JSON schema."""


class Column(NamedTuple):
    """One column."""

    name: str
    """The field, or field and entry: "x.z"."""
    kind: Kind
    unit: str = ""
    """Empty if there is none, as for a text."""

    @property
    def title(self) -> str:
        """Name and unit, such as "x.z [1]"."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name


LOG_TIME = Column("log_time", "time", "ns")
"""The clock of the recorder: Unix time; virtual time in the log of a simulation."""
SINCE_START = Column("since_start", "number", "s")
"""The same clock from the first message of the log on, so that all tables have one zero."""
TIMES = (LOG_TIME, SINCE_START)
"""The first columns of every table."""


class Table(NamedTuple):
    """One channel of the log's views."""

    name: str
    """Such as "controller/result"."""
    stem: str
    """Name of its file, such as "controller.result"."""
    columns: tuple[Column, ...]


Batch = list[list[Any]]
"""Rows of a table: one value per column, None if the message has no such value."""


class Writer(Protocol):
    """Writer of one format. Its files are complete after `close`."""

    files: list[Path]
    """Paths of the files that were begun."""

    def write(self, table: Table, rows: Batch) -> None:
        """Add rows. A table may have new columns after its old ones. Raises `OSError`."""

    def close(self) -> None:
        """Finish all files. Raises `OSError`."""
