"""The maximal robust positively invariant set of x+ = (A+BK) x + w inside X and K x in U.

The recursion is that of Gilbert and Kolmanovsky (1995): O = {x : F (A+BK)^k x <= f - support of R_k, k = 0, 1, ...},
stopped at the first k whose rows are all redundant.
"""

from __future__ import annotations

import numpy as np

from lbmpc.model import Model
from lbmpc.sets.geometry.linear_program import linprog
from lbmpc.sets.geometry.polytope import EmptySetError, Polytope, in_shares, row_ranges


def terminal_set(model: Model, X: Polytope, U: Polytope, W: Polytope, max_steps: int = 200) -> Polytope:
    """Return Omega of the paper: disturbance invariant under v = K z, inside X with K x in U.

    Raises:
        EmptySetError: there is none, with step and row in the text; or it is not determined within max_steps.
    """
    rows_x, bounds_x = X.one_sided()
    rows_u, bounds_u = U.one_sided()
    rows = np.vstack([rows_x, rows_u @ model.K])
    bounds = np.concatenate([bounds_x, bounds_u])
    if not len(rows):
        # Without any bound Omega is the whole space.
        return Polytope(rows, bounds, bounds, ())
    names, scale = _names(X) + _names(U), model.plant.x_scale
    ranges = row_ranges(rows, scale)
    closed = model.closed_loop
    kept_rows, kept_bounds = rows.copy(), bounds.copy()
    power, margin = rows.copy(), np.zeros(len(rows))
    for k in range(1, max_steps + 1):
        margin = margin + [W.support(row) for row in power]
        power = power @ closed
        bound = bounds - margin
        worst = int(np.argmin(bound / ranges))
        if bound[worst] < 0:
            raise EmptySetError(
                f"no robust positively invariant set of A + BK exists: after {k} steps the disturbance alone moves "
                f"{names[worst]} past its bound by {-bound[worst]:.3g}. "
                "A smaller W, another K or a shorter period may help."
            )
        known, candidates = in_shares(kept_rows, kept_bounds, scale), in_shares(power, bound, scale)
        new = [i for i, row in enumerate(zip(*candidates, strict=True)) if not _redundant(*row, *known)]
        if not new:
            infinite = np.full(len(kept_rows), -np.inf)
            return Polytope(
                kept_rows, infinite, kept_bounds, tuple(f"Omega row {i}" for i in range(len(kept_rows)))
            )
        kept_rows = np.vstack([kept_rows, power[new]])
        kept_bounds = np.concatenate([kept_bounds, bound[new]])
    raise EmptySetError(
        f"the robust positively invariant set of A + BK is not determined within {max_steps} steps"
    )


def _names(set_: Polytope) -> list[str]:
    high, low = np.isfinite(set_.upper), np.isfinite(set_.lower)
    upper = [f"{name} (upper)" for name, keep in zip(set_.names, high, strict=True) if keep]
    return upper + [f"{name} (lower)" for name, keep in zip(set_.names, low, strict=True) if keep]


def _redundant(row: np.ndarray, bound: float, rows: np.ndarray, bounds: np.ndarray) -> bool:
    solution = linprog(-row, rows, bounds, bounds=(None, None), method="highs")
    if solution.status == 2:
        raise EmptySetError("the robust positively invariant set of A + BK is empty")
    return solution.status == 0 and -solution.fun <= bound + 1e-9
