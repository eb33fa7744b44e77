"""Constraints beside the boxes: named rows, min <= sum of coefficients times values <= max, in plant units."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

Row = Mapping[str, float]
"""Coefficients by the name of states, or of inputs; "min", "max" or both; of states "priority", 0 where it is not said.
The boxes have priority 0. Of what contradicts each other the higher number gives way first."""
PRIORITY = "priority"
WORDS = ("min", "max", PRIORITY)
"""What is no coefficient in a row."""
HAIR = 1e-12
"""Share of the way to a row that rounding may need."""


@dataclass(frozen=True, eq=False)
class LinearRows:
    """{y : lower <= F y <= upper}; F (rows, n), bounds (rows,), infinite where there is none."""

    names: tuple[str, ...]
    F: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    priorities: tuple[int, ...]
    ranges: np.ndarray
    """|F| times the half-widths, (rows,): what counts as 1 in each row."""

    def about(self, y: np.ndarray) -> LinearRows:
        """The same rows of deviations from y, (n,)."""
        if not self.names:
            return self
        there = self.F @ y
        lower, upper = self.lower - there, self.upper - there
        return LinearRows(self.names, self.F, lower, upper, self.priorities, self.ranges)

    def beyond(self, y: np.ndarray) -> np.ndarray:
        """How far each row is beyond its bounds, as a share of its range, negative inside: (..., n) -> (..., rows)."""
        values = y @ self.F.T
        return np.asarray(np.maximum(self.lower - values, values - self.upper) / self.ranges)

    def pulled(self, y: np.ndarray, centre: np.ndarray | float) -> np.ndarray:
        """y, (..., n), drawn straight to a point inside, (n,), by the least that keeps all rows; y where it does."""
        if not self.names:
            return y
        at, there = self.F @ (centre + np.zeros(self.F.shape[1])), y @ self.F.T
        with np.errstate(all="ignore"):
            above = np.where(there > self.upper, (self.upper - at) / (there - at), 1.0)
            below = np.where(there < self.lower, (self.lower - at) / (there - at), 1.0)
        share = np.minimum(above, below).min(axis=-1)[..., None]
        return np.where(share < 1.0, centre + (1.0 - HAIR) * share * (y - centre), y)


def rows_of(rows: Mapping[str, Row], names: Sequence[str], scale: np.ndarray) -> LinearRows:
    """Those of `rows`, which are sound, whose coefficients are of `names`; scale (n,): what counts as 1 in each."""
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
    """Of n variables, whose half-widths need not be known."""
    none = np.zeros(0)
    return LinearRows((), np.zeros((0, n)), none, none, (), none)


def coefficients(row: Row) -> dict[str, float]:
    """By the name of a state or input."""
    return {name: value for name, value in row.items() if name not in WORDS}


def together(u: np.ndarray, before: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """As far from `before` on the straight way to u, (m,), as low and high let.

    All inputs move by the same share: what lies between two inputs of a convex U is in U. Input by input, each as far
    as it may, it need not be.
    """
    way = u - before
    with np.errstate(all="ignore"):
        shares = np.where(way > 0.0, high - before, before - low) / np.abs(way)
    share = float(shares[way != 0.0].min(initial=1.0))
    return u if share >= 1.0 else before + max(share, 0.0) * way
