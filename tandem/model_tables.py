"""Models as tables for a person: matrices with the names of states and inputs, poles, shares."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from rich.table import Column, Table
from rich.text import Text

UNKNOWN = 2.0
"""Standard errors below which an entry cannot be told from zero."""
ROUNDING = 1e-9
"""Of an entry in half-widths, what rounding leaves."""


def plain(*columns: Column) -> Table:
    """A table without lines."""
    return Table(*columns, box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="dim")


def matrix_table(
    states: Sequence[str],
    columns: Sequence[str],
    values: np.ndarray,
    scales: tuple[np.ndarray, np.ndarray],
    errors: np.ndarray | None = None,
) -> Table:
    """x+ of each state, one a row, from each of `columns`.

    Args:
        values: (d, n); a number that is rounding, beside its half-widths, is a dot.
        scales: half-widths of the rows, (d,), and of the columns, (n,).
        errors: standard errors, (d, n), below their numbers. A number that is not known from zero is dim.
    """
    right = [Column(name, justify="right", no_wrap=True) for name in columns]
    shown = plain(Column("", style="bold", no_wrap=True), *right)
    shown.padding = (0, 1, 0, 0)
    share = np.abs(values) * scales[1] / scales[0][:, None]
    for i, state in enumerate(states):
        cells = []
        for j in range(len(columns)):
            nothing = share[i, j] < ROUNDING
            cell = Text("·" if nothing else f"{values[i, j]:.3g}", style="dim" if nothing else "")
            if errors is not None and not nothing:
                if abs(values[i, j]) < UNKNOWN * errors[i, j]:
                    cell.stylize("dim")
                cell.append(f"\n±{errors[i, j]:.1g}", style="dim")
            cells.append(cell)
        shown.add_row(f"{state}+", *cells)
    return shown


def poles_text(poles: np.ndarray) -> str:
    """Poles, 1/s, each pair once."""
    words = []
    for pole in poles[poles.imag >= 0.0].tolist():
        real = f"{pole.real:.3g}"
        words.append(f"{real} ± {pole.imag:.3g}i" if pole.imag > ROUNDING * abs(pole) else real)
    return ", ".join(words)


def percent(share: float) -> str:
    """A share with two digits, as "12 %"; rounding is 0."""
    if share < ROUNDING:
        return "0 %"
    return f"{100.0 * share:.2g} %" if share < 1.0 else f"{100.0 * share:.0f} %"
