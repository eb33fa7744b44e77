"""Where a linear model rests that does not rest at (x_e, u_e): the nearest such point.

    a dx + b du + drift = 0

A stabilisable model has a solution for every drift: (a b) has full row rank. Of all solutions the performance states
move least, then the other states, then the inputs, each in half-widths: x_e says where the plant is wanted, and an
actuator's state, or an angle that leans into the wind, holds it there.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

HELD = 1e-9
"""Of the drift, in half-widths a second, what may be left for rounding."""
RANK = 1e-10
"""Of the largest singular value: below, nothing is moved."""


def nearest_rest(
    a: np.ndarray,
    b: np.ndarray,
    drift: np.ndarray,
    x_scale: np.ndarray,
    u_scale: np.ndarray,
    performance: Sequence[int],
) -> tuple[np.ndarray, np.ndarray] | None:
    """(dx, du), (d,) and (m,), from the point at which the model drifts.

    Args:
        a, b: slopes of the drift in x and u, (d, d) and (d, m); of a model in discrete time A - I and B.
        drift: dx/dt, or x+ - x, (d,).
        x_scale, u_scale: half-widths, (d,) and (m,).
        performance: the states that move least.

    Returns:
        None where no input and no state balances it.
    """
    d, scale = len(drift), np.concatenate([x_scale, u_scale])
    slopes, start = np.hstack([a, b]) * scale / x_scale[:, None], drift / x_scale
    others = np.setdiff1d(np.arange(d), performance)
    groups = [np.asarray(performance, dtype=int), others, np.arange(d, len(scale))]
    moved, left = np.zeros(len(scale)), start
    for k, group in enumerate(groups):
        # What those behind cannot balance, these must.
        rest = _out_of_reach(slopes[:, np.concatenate([others[:0], *groups[k + 1 :]])])
        moved[group] = -np.linalg.pinv(rest @ slopes[:, group], rcond=RANK) @ (rest @ left)
        left = left + slopes[:, group] @ moved[group]
    if not np.abs(left).max() <= HELD * max(np.abs(start).max(), np.finfo(float).tiny):
        return None
    moved = moved * scale
    return moved[:d], moved[d:]


def _out_of_reach(columns: np.ndarray) -> np.ndarray:
    """Rows, (k, d), of all directions that these columns, (d, n), do not reach."""
    if not columns.size:
        return np.eye(len(columns))
    left, values, _ = np.linalg.svd(columns)
    reached = int((values > RANK * max(values.max(), np.finfo(float).tiny)).sum())
    return np.asarray(left[:, reached:].T)
