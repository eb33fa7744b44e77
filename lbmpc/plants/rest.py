"""Where a linear model rests that does not rest at (x_e, u_e): the nearest such point.

    a dx + b du + drift = 0

A stabilisable model has a solution for every drift: (a b) has full row rank. Of all of them the state moves least, and
then the input, both in half-widths: x_e is where the plant is wanted, and u_e what holds it there.
"""

from __future__ import annotations

import numpy as np

HELD = 1e-9
"""Of the drift, in half-widths a second, what may be left for rounding."""
RANK = 1e-10
"""Of the largest singular value: below, an input moves nothing."""


def nearest_rest(
    a: np.ndarray, b: np.ndarray, drift: np.ndarray, x_scale: np.ndarray, u_scale: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """(dx, du), (d,) and (m,), from the point at which the model drifts.

    Args:
        a, b: slopes of the drift in x and u, (d, d) and (d, m); of a model in discrete time A - I and B.
        drift: dx/dt, or x+ - x, (d,).
        x_scale, u_scale: half-widths, (d,) and (m,).

    Returns:
        None where no input and no state balances it.
    """
    a, b, drift = a * x_scale / x_scale[:, None], b * u_scale / x_scale[:, None], drift / x_scale
    # What no input balances, a state must.
    u, s, _ = np.linalg.svd(b)
    out_of_reach = u[:, int((s > RANK * max(s.max(initial=0.0), np.finfo(float).tiny)).sum()) :].T
    dx = -_pseudo_inverse(out_of_reach @ a) @ (out_of_reach @ drift)
    du = -_pseudo_inverse(b) @ (drift + a @ dx)
    left = np.abs(a @ dx + b @ du + drift).max()
    if not left <= HELD * max(np.abs(drift).max(), np.finfo(float).tiny):
        return None
    return dx * x_scale, du * u_scale


def _pseudo_inverse(matrix: np.ndarray) -> np.ndarray:
    return np.linalg.pinv(matrix, rcond=RANK)
