"""The disturbance tube R_{i+1} = (A+BK) R_i + W, R_0 = {0}, by support functions.

The support of R_i in direction f is the sum over k < i of the support of W in direction ((A+BK)^k)' f, so X - R_i and
U - K R_i need no Minkowski sums and no vertices.
"""

from __future__ import annotations

import numpy as np

from lbmpc.sets.geometry.polytope import Polytope


def tube_margins(
    F: np.ndarray, closed_loop: np.ndarray, W: Polytope, steps: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the support of R_0..R_steps in the directions -F and +F, each (steps + 1, rows)."""
    low, high = np.zeros((steps + 1, len(F))), np.zeros((steps + 1, len(F)))
    rows = F.copy()
    for i in range(steps):
        low[i + 1] = low[i] + [W.support(-row) for row in rows]
        high[i + 1] = high[i] + [W.support(row) for row in rows]
        rows = rows @ closed_loop
    return low, high


def tighten(
    X: Polytope, F: np.ndarray, closed_loop: np.ndarray, W: Polytope, steps: int, what: str
) -> list[Polytope]:
    """Return X tightened by F R_0 .. F R_steps; F maps the tube's state to X's space (I for X, K for U).

    Raises:
        EmptySetError: the bounds of a constraint cross. The text names the first such step.
    """
    low, high = tube_margins(X.F @ F, closed_loop, W, steps)
    sets = [X.minus(low[i], high[i]) for i in range(steps + 1)]
    for i, tightened in enumerate(sets):
        tightened.require_rows(i, what)
    return sets
