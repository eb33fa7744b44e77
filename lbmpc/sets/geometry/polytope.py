"""Sets as rows, {x : lower <= F x <= upper}, with support functions. HiGHS solves the linear programs."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lbmpc.sets.geometry.linear_program import linprog


class SetError(ValueError):
    """A set does not meet the requirements of an operation. The text says why."""


class EmptySetError(SetError):
    """A set that must not be empty is empty. The text names the step, the constraint and the margin."""


@dataclass(frozen=True, eq=False)
class Polytope:
    """The set {x : lower <= F x <= upper}; F is (rows, n), the bounds (rows,) and may be infinite.

    `names` are the names of the rows for messages.
    """

    F: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    names: tuple[str, ...]

    @classmethod
    def box(cls, lower: np.ndarray, upper: np.ndarray, names: tuple[str, ...]) -> Polytope:
        lower, upper = np.asarray(lower, dtype=float), np.asarray(upper, dtype=float)
        return cls(np.eye(lower.size), lower, upper, names)

    @property
    def dimension(self) -> int:
        return self.F.shape[1]

    def support(self, direction: np.ndarray) -> float:
        """Return max direction' x over the set; inf if unbounded.

        Raises:
            EmptySetError: the set is empty.
        """
        if self.is_box:
            positive, negative = np.maximum(direction, 0.0), np.minimum(direction, 0.0)
            # 0 * inf is NaN, so bounds of variables outside the direction are left out.
            terms = np.where(direction > 0, self.upper, np.where(direction < 0, self.lower, 0.0))
            return float(terms @ (positive + negative))
        solution = linprog(-np.asarray(direction), *self.one_sided(), bounds=(None, None), method="highs")
        if solution.status == 3:
            return float("inf")
        if solution.status != 0:
            raise EmptySetError(f"no support: the set of {', '.join(self.names[:4])} is empty")
        return float(-solution.fun)

    @property
    def is_box(self) -> bool:
        return self.F.shape[0] == self.F.shape[1] and bool(np.array_equal(self.F, np.eye(self.dimension)))

    def minus(self, margin_low: np.ndarray, margin_high: np.ndarray) -> Polytope:
        """Tighten every row: lower + margin_low <= F x <= upper - margin_high (a Minkowski difference)."""
        return replace(self, lower=self.lower + margin_low, upper=self.upper - margin_high)

    def contains(self, x: np.ndarray, tolerance: float = 0.0) -> bool:
        y = self.F @ x
        return bool((y >= self.lower - tolerance).all() and (y <= self.upper + tolerance).all())

    def require_rows(self, step: int, what: str) -> None:
        """Raise `EmptySetError` with step, row and margin if the bounds of a row cross."""
        gap = self.upper - self.lower
        worst = int(np.argmin(gap))
        if gap[worst] < 0:
            raise EmptySetError(
                f"the tightened set is empty at step {step}: {what} {self.names[worst]} must be at least "
                f"{self.lower[worst]:.6g} and at most {self.upper[worst]:.6g} (deviation), which crosses by "
                f"{-gap[worst]:.3g}. A smaller W, another K or a shorter period may help."
            )

    def interior_point(self, scale: np.ndarray | float = 1.0) -> np.ndarray | None:
        """Return a point of the set, or None if it is empty; `scale` (n,) is the unit of each variable."""
        G, g = in_shares(*self.one_sided(), scale)
        solution = linprog(np.zeros(self.dimension), G, g, bounds=(None, None), method="highs")
        return solution.x * scale if solution.status == 0 else None

    def one_sided(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the same set as G x <= g, with finite rows only."""
        high, low = np.isfinite(self.upper), np.isfinite(self.lower)
        return np.vstack([self.F[high], -self.F[low]]), np.concatenate([self.upper[high], -self.lower[low]])


def row_ranges(F: np.ndarray, scale: np.ndarray | float) -> np.ndarray:
    """Return |F| scale, (rows,): the range of each row over variables within `scale`, (n,); 1 for a row of zeros."""
    ranges = np.abs(F * scale).sum(axis=1)
    return np.where(ranges > 0.0, ranges, 1.0)


def in_shares(G: np.ndarray, g: np.ndarray, scale: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
    """Return G x <= g in units of `scale`, (n,), with each row divided by its range.

    The tolerances of a linear program are absolute. Without this scaling, the accuracy would depend on the units.
    """
    ranges = row_ranges(G, scale)
    return G * scale / ranges[:, None], g / ranges
