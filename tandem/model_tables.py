"""Models as tables for a person: matrices with the names of states and inputs, poles, shares."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from rich.table import Column, Table
from rich.text import Text

UNKNOWN = 2.0
"""Standard errors below which an entry does not differ from zero."""
ROUNDING = 1e-9
"""Rounding error of an entry, in half-widths."""


def plain(*columns: Column) -> Table:
    """A table without lines."""
    return Table(*columns, box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="dim")


def matrix_tables(
    width: int,
    states: Sequence[str],
    columns: Sequence[str],
    values: np.ndarray,
    scales: tuple[np.ndarray, np.ndarray],
    errors: np.ndarray | None = None,
) -> Iterator[Table]:
    """x+ of each state, one a row, from each of `columns`; split into several tables if `width` requires it.

    Args:
        width: of the console, characters.
        values: (d, n); a number within rounding, in half-widths, is a dot.
        scales: half-widths of the rows, (d,), and of the columns, (n,).
        errors: standard errors, (d, n), below their numbers. A number that does not differ from zero is dim.
    """
    share = np.abs(values) * scales[1] / scales[0][:, None]
    cells = [
        [
            _cell(values[i, j], share[i, j], None if errors is None else errors[i, j])
            for i in range(len(states))
        ]
        for j in range(len(columns))
    ]
    names = [f"{state}+" for state in states]
    left = width - max(map(len, names))
    groups: list[list[int]] = [[]]
    room = left
    for j, column in enumerate(cells):
        needed = 1 + max(len(columns[j]), *(len(line) for cell in column for line in cell.plain.split("\n")))
        if needed > room and groups[-1]:
            groups.append([])
            room = left
        groups[-1].append(j)
        room -= needed
    for group in groups:
        right = [Column(columns[j], justify="right", no_wrap=True) for j in group]
        shown = plain(Column("", style="bold", no_wrap=True), *right)
        shown.padding = (0, 1, 0, 0)
        for i, name in enumerate(names):
            shown.add_row(name, *(cells[j][i] for j in group))
        yield shown


def _cell(value: float, share: float, error: float | None) -> Text:
    if share < ROUNDING:
        return Text("·", "dim")
    if error is None:
        return Text(f"{value:.3g}")
    cell = Text(f"{value:.3g}", "dim" if abs(value) < UNKNOWN * error else "")
    return cell.append(f"\n±{error:.1g}", "dim")


def poles_text(poles: np.ndarray) -> str:
    """Poles, 1/s, each pair once."""
    words = []
    for pole in poles[poles.imag >= 0.0].tolist():
        real = f"{pole.real:.3g}"
        words.append(f"{real} ± {pole.imag:.3g}i" if pole.imag > ROUNDING * abs(pole) else real)
    return ", ".join(words)


def percent(share: float) -> str:
    """A share with two digits, as "12 %"; a share within rounding is 0."""
    if share < ROUNDING:
        return "0 %"
    return f"{100.0 * share:.2g} %" if share < 1.0 else f"{100.0 * share:.0f} %"
