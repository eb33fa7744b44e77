"""`tandem export`: a log as tables of CSV or Parquet, or as a Rerun recording."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import msgspec

from lbmpc.plants import Description
from run_log.errors import LogError, LogExistsError
from run_log.exporting.source import Source
from run_log.exporting.table import Writer
from run_log.exporting.tables import Tables
from run_log.file_format import CONFIG, PLANT
from run_log.run import Run, plant_of
from run_log.views.views import Views

ABOUT = {"configuration": CONFIG, "plant": PLANT, "units": "units.json", "versions": "versions.json"}
"""Facts about a log that every format gets, and the attachments that contain them."""


class Exported(msgspec.Struct, frozen=True, kw_only=True):
    """Result of an export: the written tables, and the unreadable parts of the log."""

    log: list[str]
    """The parts that were read, in order."""
    tables: dict[str, int]
    """Rows of each table, by its name."""
    files: list[str]
    damage: list[str]
    """Damaged places of the log. The messages there are missing."""
    bad: dict[str, int]
    """Number of invalid messages, which have no row, by topic and reason."""
    strangers: dict[str, int]
    """Number of messages on unknown keys, which have no table, by key."""
    notes: list[str]
    """Notes for a person, such as where the log was cut."""


def export(
    log: str | Path,
    *,
    csv: str | Path | None = None,
    parquet: str | Path | None = None,
    rrd: str | Path | None = None,
) -> Exported:
    """Write a log in one or several formats, in one pass. The memory use does not depend on the log's length.

    Args:
        log: the file, or the first part of a log in parts.
        csv: a folder for one CSV file per table. It is created, or must be empty.
        parquet: a folder for one Parquet file per table, likewise.
        rrd: a Rerun recording, a file that does not exist yet.

    Raises:
        LogExistsError: the output exists already.
        LogError: the log cannot be read, or the output cannot be written.
        ModuleNotFoundError: pyarrow (Parquet) or rerun (Rerun) is not installed.
    """
    source = Source(Path(log))
    plant = plant_of(source.run)
    bad: dict[str, int] = {}
    try:
        writers = _writers(source.run, plant, csv, parquet, rrd)
        tables = Tables(writers)
        _write(source, plant, tables, bad)
        for writer in writers:
            writer.close()
    except OSError as error:
        raise LogError(
            f"{error.filename or 'output'}: cannot be written: {error.strerror or error}"
        ) from error
    return Exported(
        log=[str(part) for part in source.parts],
        tables=tables.rows,
        files=[str(file) for writer in writers for file in writer.files],
        damage=source.damage,
        bad=bad,
        strangers=source.strangers,
        notes=source.notes,
    )


def _write(source: Source, plant: Description, tables: Tables, bad: dict[str, int]) -> None:
    views = Views(source.run.config, plant, most_hz=math.inf)
    start: int | None = None
    for one in source:
        if start is None:
            start = one.log_time
        seen = views.show(one.name, one.payload, one.log_time)
        for shown in seen.shown:
            tables.add(shown, one.log_time, (one.log_time - start) / 1e9)
        if seen.bad is not None:
            reason = f"{seen.bad.topic}: {seen.bad.reason}"
            bad[reason] = bad.get(reason, 0) + 1
    tables.finish()


def _writers(
    run: Run, plant: Description, csv: str | Path | None, parquet: str | Path | None, rrd: str | Path | None
) -> list[Writer]:
    about = _about(run)
    writers: list[Writer] = []
    if csv is not None:
        from run_log.exporting.csv_folder import CsvFolder

        writers.append(CsvFolder(_empty_folder(csv), about))
    if parquet is not None:
        from run_log.exporting.parquet_folder import ParquetFolder

        writers.append(ParquetFolder(_empty_folder(parquet), about))
    if rrd is not None:
        from run_log.exporting.rerun_file import RerunFile

        writers.append(RerunFile(_new_file(rrd), about, plant))
    return writers


def _about(run: Run) -> dict[str, Any]:
    found: dict[str, Any] = {"log": run.path.name}
    for name, attachment in ABOUT.items():
        if attachment in run.attachments:
            try:
                found[name] = json.loads(run.attachments[attachment])
            except ValueError as error:
                raise LogError(f"{run.path}: {attachment} cannot be read: {error}") from error
    return found


def _empty_folder(folder: str | Path) -> Path:
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        taken = any(folder.iterdir())
    except OSError as error:
        raise LogError(f"{folder}: cannot be used as a folder: {error.strerror}") from error
    if taken:
        raise LogExistsError(f"{folder}: the folder is not empty; name a new one")
    return folder


def _new_file(path: str | Path) -> Path:
    path = Path(path)
    try:
        # An existing file is never overwritten.
        path.open("xb").close()
    except FileExistsError as error:
        raise LogExistsError(f"{path}: exists already; name a new file, or remove this one first") from error
    except OSError as error:
        raise LogError(f"{path}: cannot be written: {error.strerror}") from error
    return path
