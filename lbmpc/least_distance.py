"""Least-distance problems with few active rows out of many: min |w|^2 / 2, lower <= y + M w <= upper.

DAQP solves them; it is shown only the rows that some iterate violated, which in MPC are few.
"""

from __future__ import annotations

from dataclasses import dataclass

import daqp
import numpy as np

# DAQP's own default, 1e-6, moves the first input by 5e-6.
PRIMAL_TOLERANCE = 1e-9
SOFT = 8


@dataclass(frozen=True, eq=False)
class Penalty:
    """Soft rows pay weight (e + e^2 / 2), e = violation / scale; exact for multipliers up to weight / scale."""

    soft: np.ndarray
    """Which rows are soft, (rows,) of bool."""
    scale: np.ndarray
    """Violation that counts as 1, (rows,)."""
    weight: float

    def cost(self, violation: np.ndarray) -> float:
        """Sum over the soft rows; violation is (rows,), zero where kept."""
        if not violation.any():
            return 0.0
        e = violation[self.soft] / self.scale[self.soft]
        return self.weight * float(np.sum(e + 0.5 * e * e))


def violation(values: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """How far each row is outside its bounds, zero inside; (rows,)."""
    return np.maximum(np.maximum(lower - values, values - upper), 0.0)


@dataclass(frozen=True, eq=False)
class Nearest:
    """Minimiser w (n,), the row values y + M w (rows,) there, and the rows that the QP was shown."""

    w: np.ndarray
    values: np.ndarray
    seen: np.ndarray


NO_ROWS: np.ndarray = np.zeros(0, dtype=np.intp)


def least_distance(
    y: np.ndarray,
    M: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
    penalty: Penalty | None,
    hint: np.ndarray = NO_ROWS,
) -> Nearest | None:
    """The minimiser, or None when hard rows contradict each other or the numbers are unusable.

    Args:
        y: row values at w = 0, (rows,).
        M: how they move with w, (rows, n).
        lower, upper: bounds, (rows,).
        penalty: None when every row is hard.
        hint: indices of rows to show from the start; they change the time, not the result.
    """
    n = M.shape[1]
    identity, zero = np.eye(n), np.zeros(n)
    w, values = zero, y
    seen, unseen = hint, np.ones(len(y), dtype=bool)
    unseen[hint] = False
    # Each round adds a row at least, so the rows themselves bound the rounds.
    for _ in range(len(y) + 1):
        new = np.flatnonzero(
            ((values > upper + PRIMAL_TOLERANCE) | (values < lower - PRIMAL_TOLERANCE)) & unseen
        )
        if new.size == 0 and w is not zero:
            return Nearest(w, values, seen)
        unseen[new] = False
        seen = np.concatenate([seen, new])
        found = _solve_shown(identity, zero, y[seen], M[seen], lower[seen], upper[seen], penalty, seen)
        if found is None:
            return None
        w = found
        values = y + M @ w
    return None


def _solve_shown(
    identity: np.ndarray,
    zero: np.ndarray,
    y: np.ndarray,
    rows: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
    penalty: Penalty | None,
    seen: np.ndarray,
) -> np.ndarray | None:
    norms = np.sqrt(np.einsum("ij,ij->i", rows, rows))
    if not (norms > 1e-12).all():
        return None
    soft = np.where(penalty.soft[seen], SOFT, 0) if penalty is not None else np.zeros(len(seen))
    model = daqp.Model()
    model.settings = {"primal_tol": PRIMAL_TOLERANCE}
    # Rows of length 1, so that DAQP's tolerances and weights mean distances.
    inverse = 1.0 / norms
    flag, _time = model.setup(
        identity,
        zero,
        rows * inverse[:, None],
        (upper - y) * inverse,
        (lower - y) * inverse,
        soft.astype(np.intc),
    )
    if flag < 0:
        return None
    if penalty is not None:
        unit = norms / penalty.scale[seen]
        linear, quadratic = penalty.weight * unit, 1.0 / (penalty.weight * unit * unit)
        model.soft_weights(quadratic, quadratic, linear, linear)
    w, _value, flag, _info = model.solve()
    return w if flag > 0 and np.isfinite(w).all() else None
