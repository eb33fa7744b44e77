"""A log as a folder of CSV files, one per table, and one JSON file that describes them."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from run_log.exporting.table import Batch, Kind, Table

ABOUT = "about.json"
TEXTS: dict[Kind, Callable[[Any], str]] = {"boolean": json.dumps, "numbers": json.dumps}
"""Texts for values that Python writes in another way."""


class CsvFolder:
    """Writes CSV: numbers as the shortest text with the same bits, flags as true and false, lists as JSON.

    An absent value is empty.

    Args:
        folder: an existing, empty folder.
        about: facts about the whole log: configuration, versions, units.
    """

    def __init__(self, folder: Path, about: Mapping[str, Any]):
        self.files: list[Path] = []
        self._folder, self._about = folder, about
        self._tables: dict[str, Table] = {}
        self._rows: dict[str, int] = {}

    def write(self, table: Table, rows: Batch) -> None:
        path = self._path(table)
        before = self._tables.get(table.name)
        if before is None:
            self.files.append(path)
            _write(path, "x", [_titles(table)])
        elif before != table:
            _widen(path, table)
        self._tables[table.name] = table
        self._rows[table.name] = self._rows.get(table.name, 0) + len(rows)
        texts = [(i, TEXTS[column.kind]) for i, column in enumerate(table.columns) if column.kind in TEXTS]
        _write(path, "a", (_with_texts(row, texts) for row in rows) if texts else rows)

    def close(self) -> None:
        tables = {
            name: {
                "file": self._path(table).name,
                "rows": self._rows[name],
                "columns": [column._asdict() for column in table.columns],
            }
            for name, table in self._tables.items()
        }
        path = self._folder / ABOUT
        text = json.dumps({**self._about, "tables": tables}, indent=2, ensure_ascii=False)
        path.write_text(text + "\n", encoding="utf-8")
        self.files.append(path)

    def _path(self, table: Table) -> Path:
        return self._folder / f"{table.stem}.csv"


def _titles(table: Table) -> list[str]:
    return [column.title for column in table.columns]


def _write(path: Path, mode: str, rows: Iterable[list[Any]]) -> None:
    with path.open(mode, encoding="utf-8", newline="") as stream:
        csv.writer(stream, lineterminator="\n").writerows(rows)


def _widen(path: Path, table: Table) -> None:
    """Add the new columns, which are empty in the rows so far."""
    old = path.with_suffix(".old")
    path.rename(old)
    with old.open(encoding="utf-8", newline="") as stream:
        rows = csv.reader(stream)
        more = [""] * (len(table.columns) - len(next(rows)))
        _write(path, "x", [_titles(table)])
        _write(path, "a", (row + more for row in rows))
    old.unlink()


def _with_texts(row: list[Any], texts: list[tuple[int, Callable[[Any], str]]]) -> list[Any]:
    shown = row.copy()
    for i, text in texts:
        if shown[i] is not None:
            shown[i] = text(shown[i])
    return shown
