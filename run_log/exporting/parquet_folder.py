"""A log as a folder of Parquet files, one per table."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from run_log.exporting.table import Batch, Column, Kind, Table

TYPES: dict[Kind, pa.DataType] = {
    "time": pa.timestamp("ns", tz="UTC"),
    "number": pa.float64(),
    "integer": pa.int64(),
    "boolean": pa.bool_(),
    "string": pa.string(),
    "numbers": pa.list_(pa.float64()),
    "json": pa.string(),
}
COMPRESSION = "zstd"


class ParquetFolder:
    """Writes Parquet: the metadata of a column has its unit, and that of a file the facts about the whole log.

    Args:
        folder: an existing, empty folder.
        about: facts about the log: configuration, versions, units. NAME becomes the key "tandem.NAME" (JSON).
    """

    def __init__(self, folder: Path, about: Mapping[str, Any]):
        self.files: list[Path] = []
        self._folder = folder
        self._about = {
            f"tandem.{name}": json.dumps(value, ensure_ascii=False) for name, value in about.items()
        }
        self._tables: dict[str, Table] = {}
        self._open: dict[str, pq.ParquetWriter] = {}

    def write(self, table: Table, rows: Batch) -> None:
        before = self._tables.get(table.name)
        if before is None:
            self.files.append(self._path(table))
            self._begin(table)
        elif before != table:
            self._widen(table)
        self._tables[table.name] = table
        schema = self._schema(table)
        columns = zip(zip(*rows, strict=True), schema, strict=True)
        arrays = [pa.array(values, field.type) for values, field in columns]
        self._open[table.name].write_table(pa.Table.from_arrays(arrays, schema=schema))

    def close(self) -> None:
        for writer in self._open.values():
            writer.close()

    def _path(self, table: Table) -> Path:
        return self._folder / f"{table.stem}.parquet"

    def _begin(self, table: Table) -> None:
        self._open[table.name] = pq.ParquetWriter(
            self._path(table), self._schema(table), compression=COMPRESSION
        )

    def _widen(self, table: Table) -> None:
        """Add the new columns, which are null in the rows so far."""
        self._open[table.name].close()
        path = self._path(table)
        old = path.with_suffix(".old")
        path.rename(old)
        self._begin(table)
        schema = self._schema(table)
        with pq.ParquetFile(old) as file:
            for i in range(file.num_row_groups):
                rows = file.read_row_group(i)
                for field in schema.names[rows.num_columns :]:
                    rows = rows.append_column(
                        schema.field(field), pa.nulls(len(rows), schema.field(field).type)
                    )
                self._open[table.name].write_table(rows.cast(schema))
        old.unlink()

    def _schema(self, table: Table) -> pa.Schema:
        return pa.schema(
            [_field(column) for column in table.columns], {**self._about, "tandem.table": table.name}
        )


def _field(column: Column) -> pa.Field:
    return pa.field(column.name, TYPES[column.kind], metadata={"unit": column.unit} if column.unit else None)
