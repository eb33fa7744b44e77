"""Sets as rows: {x : lower <= F x <= upper}, with support functions. Linear programs go to HiGHS."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lbmpc.sets.geometry.linear_program import linprog


class SetError(ValueError):
    """A set is not what an operation needs; the text says what it is instead."""


class EmptySetError(SetError):
    """A set that should hold something is empty; the text names the step, the constraint and the margin."""


@dataclass(frozen=True, eq=False)
class Polytope:
    """{x : lower <= F x <= upper}; F is (rows, n), the bounds (rows,) and may be infinite.

    `names` says which constraint each row is, for messages.
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
        """max direction' x over the set; inf when unbounded.

        Raises:
            EmptySetError: the set holds nothing.
        """
        if self.is_box:
            positive, negative = np.maximum(direction, 0.0), np.minimum(direction, 0.0)
            # 0 * inf is not a number; a direction that does not look at a variable does not see its bound.
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
        """Every row drawn in: lower + margin_low <= F x <= upper - margin_high (a Minkowski difference)."""
        return replace(self, lower=self.lower + margin_low, upper=self.upper - margin_high)

    def contains(self, x: np.ndarray, tolerance: float = 0.0) -> bool:
        y = self.F @ x
        return bool((y >= self.lower - tolerance).all() and (y <= self.upper + tolerance).all())

    def require_rows(self, step: int, what: str) -> None:
        """Raise `EmptySetError` when some row's bounds cross, naming step, row and margin."""
        gap = self.upper - self.lower
        worst = int(np.argmin(gap))
        if gap[worst] < 0:
            raise EmptySetError(
                f"the tightened set is empty at step {step}: {what} {self.names[worst]} must be at least "
                f"{self.lower[worst]:.6g} and at most {self.upper[worst]:.6g} (deviation), which crosses by "
                f"{-gap[worst]:.3g}. A smaller W, another K or a shorter period would help."
            )

    def interior_point(self, scale: np.ndarray | float = 1.0) -> np.ndarray | None:
        """Some point of the set, or None when it is empty; `scale` (n,): what counts as 1 in each variable."""
        G, g = in_shares(*self.one_sided(), scale)
        solution = linprog(np.zeros(self.dimension), G, g, bounds=(None, None), method="highs")
        return solution.x * scale if solution.status == 0 else None

    def one_sided(self) -> tuple[np.ndarray, np.ndarray]:
        """The same set as G x <= g, finite rows only."""
        high, low = np.isfinite(self.upper), np.isfinite(self.lower)
        return np.vstack([self.F[high], -self.F[low]]), np.concatenate([self.upper[high], -self.lower[low]])


def row_ranges(F: np.ndarray, scale: np.ndarray | float) -> np.ndarray:
    """|F| scale, (rows,): each row's range where every variable goes to its `scale`, (n,); 1 for a row of zeros."""
    ranges = np.abs(F * scale).sum(axis=1)
    return np.where(ranges > 0.0, ranges, 1.0)


def in_shares(G: np.ndarray, g: np.ndarray, scale: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
    """G x <= g in units of `scale`, (n,), each row as a share of its range.

    The tolerances of a linear program are absolute: in other units the same rows would be kept more or less well.
    """
    ranges = row_ranges(G, scale)
    return G * scale / ranges[:, None], g / ranges
