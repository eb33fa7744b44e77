"""A log as one Rerun recording: numbers as series, texts as a text log, and a layout of the main plots."""

from __future__ import annotations

import errno
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun.chunk import RrdReader

from lbmpc.plants import Description
from run_log.exporting.table import LOG_TIME, SINCE_START, TIMES, Batch, Column, Table

APPLICATION = "tandem"
STATE = ("plant/state/x", "bounds/x_min", "bounds/x_max", "targets/x")
INPUT = ("controller/command/u", "plant/state/applied", "bounds/u_min", "bounds/u_max", "targets/u")
ERROR = ("controller/result/h", "controller/result/h_hat")
"""The series of one plot, without the name of the state or the input."""
EVENTS = "events"
LEVELS = ("TRACE", "DEBUG", "INFO", "WARN", "ERROR", "CRITICAL")
"""Rerun's levels for the levels 0 to 5 of foxglove.Log."""


class RerunFile:
    """Writes Rerun: each number is a series at TABLE/FIELD/ENTRY, and each text a text log of its changes.

    Lists are left out. The timelines are the time columns of a table.

    Args:
        path: a file that does not exist yet.
        about: facts about the log: configuration, versions, units. Each entry is a document at about/NAME.
        plant: its states and inputs are the plots of the layout.
    """

    def __init__(self, path: Path, about: Mapping[str, Any], plant: Description):
        self.files: list[Path] = []
        # Rerun needs a separate recording for every file.
        self._stream = rr.RecordingStream(APPLICATION)
        with _refused(path):
            self._stream.save(path, default_blueprint=_layout(plant))
        self.files.append(path)
        self._said: dict[str, str] = {}
        """Newest text, by entity."""
        self._named: set[str] = set()
        for name, value in about.items():
            text = json.dumps(value, indent=2, ensure_ascii=False)
            self._stream.log(f"about/{name}", rr.TextDocument(text), static=True)

    def write(self, table: Table, rows: Batch) -> None:
        if table.name == EVENTS:
            self._write_events(table, rows)
        else:
            self._write_series(table, rows)

    def close(self) -> None:
        path = self.files[0]
        with _refused(path):
            self._stream.flush()
            self._stream.disconnect()
            # Rerun writes in its own thread and only warns of a full disk. A complete file has an index.
            RrdReader(path).store()

    def _write_events(self, table: Table, rows: Batch) -> None:
        stamps, since, *others = zip(*rows, strict=True)
        columns = dict(zip((column.name for column in table.columns[len(TIMES) :]), others, strict=True))
        texts = [f"{name}: {text}" for name, text in zip(columns["name"], columns["message"], strict=True)]
        levels = [LEVELS[level] for level in columns["level"]]
        self._stream.send_columns(EVENTS, _times(stamps, since), rr.TextLog.columns(text=texts, level=levels))

    def _write_series(self, table: Table, rows: Batch) -> None:
        stamps, since, *columns = zip(*rows, strict=True)
        for column, values in zip(table.columns[len(TIMES) :], columns, strict=True):
            entity = rr.new_entity_path([*table.name.split("/"), *column.name.split(".")])
            if column.kind in ("numbers", "json"):
                continue
            if column.kind == "string":
                there = self._changes(entity, values)
            else:
                there = [i for i, value in enumerate(values) if value is not None]
            if not there:
                continue
            shown = [values[i] for i in there]
            times = _times([stamps[i] for i in there], [since[i] for i in there])
            if column.kind == "string":
                self._stream.send_columns(entity, times, rr.TextLog.columns(text=shown))
                continue
            self._name(entity, column)
            self._stream.send_columns(entity, times, rr.Scalars.columns(scalars=np.array(shown, dtype=float)))

    def _name(self, entity: str, column: Column) -> None:
        if entity not in self._named:
            self._named.add(entity)
            self._stream.log(entity, rr.SeriesLines(names=column.title), static=True)

    def _changes(self, entity: str, texts: Sequence[str | None]) -> list[int]:
        """Return the indices of the texts that differ from the previous one."""
        found = []
        for i, text in enumerate(texts):
            if text is not None and text != self._said.get(entity):
                self._said[entity] = text
                found.append(i)
        return found


@contextmanager
def _refused(path: Path) -> Iterator[None]:
    """Convert Rerun's `RuntimeError` into the `OSError` that a `Writer` raises."""
    try:
        yield
    except RuntimeError as error:
        raise OSError(errno.EIO, f"the Rerun file is incomplete: {error}", str(path)) from error


def _times(stamps: Sequence[int], since: Sequence[float]) -> list[rr.TimeColumn]:
    passed = np.round(np.array(since) * 1e9).astype("timedelta64[ns]")
    return [
        rr.TimeColumn(LOG_TIME.name, timestamp=np.array(stamps, dtype="datetime64[ns]")),
        rr.TimeColumn(SINCE_START.name, duration=passed),
    ]


def _layout(plant: Description) -> rrb.Blueprint:
    """Return the layout: states and inputs with bounds and targets, h with h_hat, times, and events."""
    plots = [_plot(plant, name, STATE) for name in plant.states]
    plots += [_plot(plant, name, INPUT) for name in plant.inputs]
    plots += [_plot(plant, plant.states[i], ERROR, "h of ") for i in plant.performance]
    times = [f"/controller/timing/{name}" for name in ("solve_ms", "tick_ms")]
    plots.append(rrb.TimeSeriesView(name="time of a tick [ms]", origin="/", contents=times))
    events = rrb.TextLogView(name="events", origin="/events")
    return rrb.Blueprint(
        rrb.Tabs(rrb.Grid(*plots, grid_columns=2, name="plots"), events), collapse_panels=True
    )


def _plot(plant: Description, name: str, series: Sequence[str], what: str = "") -> rrb.TimeSeriesView:
    title = Column(what + name, "number", plant.units.get(name, "")).title
    return rrb.TimeSeriesView(name=title, origin="/", contents=[f"/{one}/{name}" for one in series])
