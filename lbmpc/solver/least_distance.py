"""Least-distance problems with few active rows out of many: min |w|^2 / 2, lower <= y + M w <= upper.

DAQP solves them. It receives only the rows that some iterate violated, which are few in MPC.
"""

from __future__ import annotations

from dataclasses import dataclass

import daqp
import numpy as np

# Tolerance of w, and of each row relative to its scale. DAQP's default, 1e-6, moves the first input by 5e-6.
PRIMAL_TOLERANCE = 1e-9
UNMOVED = 1e-12
"""Share of a row's scale. A row that w = 1 moves by less does not depend on w, and a soft one then keeps its violation.
An example is a position at the first step of a model whose input changes the velocity."""
SOFT = 8


@dataclass(frozen=True, eq=False)
class Penalty:
    """Cost of soft rows: weight (e + e^2 / 2), e = violation / scale; exact for multipliers up to weight / scale."""

    soft: np.ndarray
    """Mask of the soft rows, (rows,) of bool."""
    scale: np.ndarray
    """Units of the rows, (rows,), also for hard rows, whose tolerance uses them."""
    weight: float

    def cost(self, violation: np.ndarray) -> float:
        """Return the sum over the soft rows; violation is (rows,), zero for satisfied rows."""
        if not violation.any():
            return 0.0
        e = violation[self.soft] / self.scale[self.soft]
        return self.weight * float(np.sum(e + 0.5 * e * e))


def violation(values: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Return the violation of each row, zero inside its bounds; (rows,)."""
    return np.maximum(np.maximum(lower - values, values - upper), 0.0)


NO_ROWS: np.ndarray = np.zeros(0, dtype=np.intp)


class Shown:
    """The QP over a subset of the rows, set up once and solved for several y.

    Args:
        M, lower, upper, penalty: as for `least_distance`.
        seen: indices of the rows.
    """

    def __init__(
        self, M: np.ndarray, lower: np.ndarray, upper: np.ndarray, penalty: Penalty, seen: np.ndarray
    ):
        self.seen, self._free = seen, M.shape[1]
        rows = M[seen]
        norms = np.sqrt(np.einsum("ij,ij->i", rows, rows))
        moved = norms > UNMOVED * penalty.scale[seen]
        self._usable = not np.isnan(norms).any()
        # Hard rows that do not depend on w are either satisfied or not.
        fixed = seen[~moved & ~penalty.soft[seen]]
        self._fixed, self._low, self._high = fixed, lower[fixed], upper[fixed]
        if not moved.all():
            seen, rows, norms = seen[moved], rows[moved], norms[moved]
        self._own = seen
        # Rows of length 1 give DAQP's tolerances and weights the meaning of distances.
        self._inverse = 1.0 / norms
        self._rows = rows * self._inverse[:, None]
        self._lower, self._upper = lower[seen] * self._inverse, upper[seen] * self._inverse
        self._sense = np.zeros(len(seen), dtype=np.intc)
        self._sense[penalty.soft[seen]] = SOFT
        unit = norms / penalty.scale[seen]
        self._weights = 1.0 / (penalty.weight * unit * unit), penalty.weight * unit
        self._model: daqp.Model | None = None

    def solve(self, y: np.ndarray) -> np.ndarray | None:
        """Return w (n,) for the row values y (rows,) at w = 0; None if the rows conflict."""
        fixed = y[self._fixed]
        if not (self._usable and (fixed >= self._low).all() and (fixed <= self._high).all()):
            return None
        if not len(self._own):
            # Rows may be violated by less than the tolerance, so no row moves w away from 0.
            return np.zeros(self._free)
        offset = y[self._own] * self._inverse
        if self._model is None:
            flag = self._set_up(offset)
        else:
            flag = self._model.update(bupper=self._upper - offset, blower=self._lower - offset)
        if flag < 0 or self._model is None:
            return None
        w, _value, flag, _info = self._model.solve()
        return w if flag > 0 and np.isfinite(w).all() else None

    def _set_up(self, offset: np.ndarray) -> int:
        n = self._rows.shape[1]
        self._model = daqp.Model()
        self._model.settings = {"primal_tol": PRIMAL_TOLERANCE}
        flag, _time = self._model.setup(
            np.eye(n), np.zeros(n), self._rows, self._upper - offset, self._lower - offset, self._sense
        )
        if flag >= 0 and self._sense.any():
            quadratic, linear = self._weights
            self._model.soft_weights(quadratic, quadratic, linear, linear)
        return int(flag)


@dataclass(frozen=True, eq=False)
class Nearest:
    """Minimiser w (n,), the row values y + M w (rows,), and the QP."""

    w: np.ndarray
    values: np.ndarray
    shown: Shown


def least_distance(
    y: np.ndarray,
    M: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
    penalty: Penalty,
    hint: np.ndarray = NO_ROWS,
    ready: Shown | None = None,
) -> Nearest | None:
    """Return the minimiser; None if hard rows conflict or the numbers are not finite.

    Args:
        y: row values at w = 0, (rows,).
        M: slopes of the rows in w, (rows, n).
        lower, upper: bounds, (rows,).
        penalty: soft rows, and the scales of all rows.
        hint: indices of rows to include from the start. They affect the time, not the result.
        ready: an existing QP over rows of the same M to start with.
    """
    low, high = lower - PRIMAL_TOLERANCE * penalty.scale, upper + PRIMAL_TOLERANCE * penalty.scale
    seen = ready.seen if ready is not None else hint
    unseen = np.ones(len(y), dtype=bool)
    unseen[seen] = False
    values, shown = y, ready
    if shown is None:
        seen = np.concatenate([seen, np.flatnonzero(((y > high) | (y < low)) & unseen)])
    # Each round adds at least one row, so the number of rows limits the rounds.
    for _ in range(len(y) + 1):
        shown = shown or Shown(M, lower, upper, penalty, seen)
        w = shown.solve(y)
        if w is None:
            return None
        values = y + M @ w
        unseen[shown.seen] = False
        new = np.flatnonzero(((values > high) | (values < low)) & unseen)
        if new.size == 0:
            return Nearest(w, values, shown)
        seen, shown = np.concatenate([shown.seen, new]), None
    return None
