"""The rest nearest to (x_e, u_e), for a linear model that does not rest there.

    a dx + b du + drift = 0

A stabilisable model has a solution for every drift, because (a b) has full row rank. Among all solutions the
performance states move least, then the other states, then the inputs, each in half-widths. x_e is the desired state,
and other states, such as an actuator's or a tilt into the wind, balance the drift.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

HELD = 1e-9
"""Residual drift that counts as rounding, relative to the drift, in half-widths per second."""
RANK = 1e-10
"""Share of the largest singular value that counts as zero."""


def nearest_rest(
    a: np.ndarray,
    b: np.ndarray,
    drift: np.ndarray,
    x_scale: np.ndarray,
    u_scale: np.ndarray,
    performance: Sequence[int],
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the displacement (dx, du), (d,) and (m,), from the point with the given drift.

    Args:
        a, b: derivatives of the drift in x and u, (d, d) and (d, m); A - I and B for a discrete-time model.
        drift: dx/dt, or x+ - x, (d,).
        x_scale, u_scale: half-widths, (d,) and (m,).
        performance: indices of the states that move least.

    Returns:
        The displacement; None if no input and no state balances the drift.
    """
    d, scale = len(drift), np.concatenate([x_scale, u_scale])
    slopes, start = np.hstack([a, b]) * scale / x_scale[:, None], drift / x_scale
    others = np.setdiff1d(np.arange(d), performance)
    groups = [np.asarray(performance, dtype=int), others, np.arange(d, len(scale))]
    moved, left = np.zeros(len(scale)), start
    for k, group in enumerate(groups):
        # This group must balance the part that the later groups cannot balance.
        rest = _out_of_reach(slopes[:, np.concatenate([others[:0], *groups[k + 1 :]])])
        moved[group] = -np.linalg.pinv(rest @ slopes[:, group], rcond=RANK) @ (rest @ left)
        left = left + slopes[:, group] @ moved[group]
    if not np.abs(left).max() <= HELD * max(np.abs(start).max(), np.finfo(float).tiny):
        return None
    moved = moved * scale
    return moved[:d], moved[d:]


def _out_of_reach(columns: np.ndarray) -> np.ndarray:
    """Return rows, (k, d), that span all directions outside the range of these columns, (d, n)."""
    if not columns.size:
        return np.eye(len(columns))
    left, values, _ = np.linalg.svd(columns)
    reached = int((values > RANK * max(values.max(), np.finfo(float).tiny)).sum())
    return np.asarray(left[:, reached:].T)
