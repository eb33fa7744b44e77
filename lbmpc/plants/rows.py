"""Constraints in addition to the boxes: named rows, min <= sum of coefficients times values <= max, in plant units."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

Row = Mapping[str, float]
"""A row: coefficients by the names of states or of inputs; "min", "max" or both; for states also "priority" (default
0). The boxes have priority 0. If constraints conflict, the one with the higher number is violated first."""
PRIORITY = "priority"
WORDS = ("min", "max", PRIORITY)
"""Keys of a row that are not coefficients."""
HAIR = 1e-12
"""Share of the distance to a row that is reserved for rounding."""


@dataclass(frozen=True, eq=False)
class LinearRows:
    """The set {y : lower <= F y <= upper}; F (rows, n), bounds (rows,), infinite if there is none."""

    names: tuple[str, ...]
    F: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    priorities: tuple[int, ...]
    ranges: np.ndarray
    """|F| times the half-widths, (rows,): the unit of each row."""

    def about(self, y: np.ndarray) -> LinearRows:
        """Return the same rows for deviations from y, (n,)."""
        if not self.names:
            return self
        there = self.F @ y
        lower, upper = self.lower - there, self.upper - there
        return LinearRows(self.names, self.F, lower, upper, self.priorities, self.ranges)

    def beyond(self, y: np.ndarray) -> np.ndarray:
        """Return the violation of each row as a share of its range, negative inside: (..., n) -> (..., rows)."""
        values = y @ self.F.T
        return np.asarray(np.maximum(self.lower - values, values - self.upper) / self.ranges)

    def pulled(self, y: np.ndarray, centre: np.ndarray | float) -> np.ndarray:
        """Move y, (..., n), towards an interior point, (n,), just far enough to satisfy all rows."""
        if not self.names:
            return y
        at, there = self.F @ (centre + np.zeros(self.F.shape[1])), y @ self.F.T
        with np.errstate(all="ignore"):
            above = np.where(there > self.upper, (self.upper - at) / (there - at), 1.0)
            below = np.where(there < self.lower, (self.lower - at) / (there - at), 1.0)
        share = np.minimum(above, below).min(axis=-1)[..., None]
        return np.where(share < 1.0, centre + (1.0 - HAIR) * share * (y - centre), y)


def rows_of(rows: Mapping[str, Row], names: Sequence[str], scale: np.ndarray) -> LinearRows:
    """Return the valid `rows` with coefficients of `names`; scale (n,) is the unit of each variable."""
    own = {key: row for key, row in rows.items() if any(name in names for name in coefficients(row))}
    F = np.array([[row.get(name, 0.0) for name in names] for row in own.values()], dtype=float)
    F = F.reshape(len(own), len(names))
    return LinearRows(
        tuple(own),
        F,
        np.array([row.get("min", -np.inf) for row in own.values()], dtype=float),
        np.array([row.get("max", np.inf) for row in own.values()], dtype=float),
        tuple(int(row.get(PRIORITY, 0)) for row in own.values()),
        np.abs(F * scale).sum(axis=1),
    )


def no_rows(n: int) -> LinearRows:
    """Return an empty set of rows for n variables; their half-widths need not be known."""
    none = np.zeros(0)
    return LinearRows((), np.zeros((0, n)), none, none, (), none)


def coefficients(row: Row) -> dict[str, float]:
    """Return the coefficients by the name of a state or input."""
    return {name: value for name, value in row.items() if name not in WORDS}


def together(u: np.ndarray, before: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the point on the line from `before` to u, (m,), that is as far as `low` and `high` allow.

    All inputs move by the same share, so the result stays in a convex U. Clipping input by input could leave U.
    """
    way = u - before
    with np.errstate(all="ignore"):
        shares = np.where(way > 0.0, high - before, before - low) / np.abs(way)
    share = float(shares[way != 0.0].min(initial=1.0))
    return u if share >= 1.0 else before + max(share, 0.0) * way
