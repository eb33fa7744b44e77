"""Set-points as a person writes them, converted to a `Reference`: "y=1.8", or a table of times and values."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from controller_node.asked import RefusedReference, change_of
from lbmpc.plants import Description
from protocol import messages as m
from tandem.terminal import Refused

UNSAID = "unsaid"
"""run_id of a message that was not sent yet."""
TIME = "time"
LARGEST = 1024 * 1024
"""Bytes of a table."""


def set_point(values: Mapping[str, float], over: float = 0.0, lease: float | None = None) -> m.Reference:
    """Values by the name of a state, plant units, reached in a straight line over so many seconds, or at once.

    lease: seconds after which the configured reference returns; None: never.
    """
    row = [float(value) for value in values.values()]
    return m.Reference(
        run_id=UNSAID, seq=0, outputs=[*values], times=[float(over)], values=[row], lease=lease
    )


def trajectory(
    times: Sequence[float], values: Mapping[str, Sequence[float]], lease: float | None = None
) -> m.Reference:
    """Points in time, in seconds from acceptance, and for each the values by the name of a state.

    Straight lines lead from point to point; two points of one time are a step.
    """
    rows = [list(map(float, row)) for row in zip(*values.values(), strict=True)]
    return m.Reference(
        run_id=UNSAID, seq=0, outputs=[*values], times=[*map(float, times)], values=rows, lease=lease
    )


def from_words(words: Sequence[str]) -> dict[str, float]:
    """Parse words such as "y=1.8". Raises `Refused`."""
    values: dict[str, float] = {}
    for word in words:
        name, equals, number = word.partition("=")
        try:
            value = float(number) if equals and name not in values else math.nan
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise Refused(f"{word}: write NAME=VALUE, with a finite number and each name once, as in y=1.8")
        values[name] = value
    return values


def from_file(path: Path, lease: float | None = None) -> m.Reference:
    """Read a CSV file whose first line names its columns: time, and states. Raises `Refused`."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = [row for row in csv.reader(file.read(LARGEST).splitlines()) if row]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise Refused(f"{path}: cannot be read ({error})") from error
    names = [name.strip() for name in rows[0]] if rows else []
    if len(names) < 2 or names[0] != TIME or len(set(names)) < len(names):
        found = f", and it is {','.join(names)[:60]!r}" if names else ""
        raise Refused(
            f"{path}: the first line must name the columns: {TIME}, then states, each once, as in time,y{found}"
        )
    if not 1 < len(rows) <= m.MOST_POINTS + 1:
        raise Refused(f"{path}: {len(rows) - 1} rows; give 1 to {m.MOST_POINTS} below the column names")
    table = []
    for number, row in enumerate(rows[1:], 2):
        try:
            table.append([float(entry) for entry in row])
        except ValueError as error:
            raise Refused(f"{path}: row {number}: {error}") from error
        if len(row) != len(names):
            raise Refused(f"{path}: row {number} has {len(row)} entries, and there are {len(names)} columns")
    columns = [*zip(*table, strict=True)]
    return trajectory(columns[0], dict(zip(names[1:], columns[1:], strict=True)), lease)


def require_fit(reference: m.Reference, plant: Description, period: float, where: str) -> None:
    """Raise `Refused` if a controller of this plant would refuse the reference; the text begins with `where`."""
    try:
        change_of(reference, plant, period)
    except RefusedReference as error:
        raise Refused(f"{where}: {error}") from error
