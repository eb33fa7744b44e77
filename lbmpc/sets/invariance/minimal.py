"""The minimal robust positively invariant set of x+ = (A + BK) x + w, and gains K for which it fits into X and U.

F_inf = sum over i of (A+BK)^i W is the smallest set that the error of a tube can be kept in. A robust positively
invariant set inside X, with K x in U, exists for K if and only if F_inf is inside X and K F_inf inside U.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_discrete_are
from scipy.optimize import minimize

from lbmpc.model import Model
from lbmpc.sets.geometry.operations import Supported
from lbmpc.sets.geometry.polytope import EmptySetError, Polytope, SetError

MOST_STEPS = 2_000


@dataclass(frozen=True, eq=False)
class OuterMrpi:
    """W + A_K W + ... + A_K^(s-1) W + rest, with A_K^s F_inf inside the rest: it holds F_inf.

    The rest is alpha / (1 - alpha) times the same sum for a box about W, alpha such that A_K^s maps that box into alpha
    times itself (Raković, Kerrigan, Kouramas and Mayne 2005). For a box W the set is theirs, and invariant.
    """

    closed_loop: np.ndarray
    W: Supported
    half_widths: np.ndarray
    """Of the box about W, (d,)."""
    alpha: float
    steps: int

    def support(self, directions: np.ndarray) -> np.ndarray:
        """max f' x over the set for each row f of directions (r, d); (r,)."""
        return self._sum(directions) + self.excess(directions)

    def excess(self, directions: np.ndarray) -> np.ndarray:
        """By how much the set reaches beyond F_inf at most in each direction, (r,)."""
        stack = self._stack(directions)
        boxes = np.abs(stack).reshape(-1, len(self.half_widths)) @ self.half_widths
        return np.asarray(boxes.reshape(stack.shape[:2]).sum(axis=0) * self.alpha / (1.0 - self.alpha))

    def _sum(self, directions: np.ndarray) -> np.ndarray:
        stack = self._stack(directions)
        reach = self.W.support(stack.reshape(-1, stack.shape[2]))
        return np.asarray(reach.reshape(stack.shape[:2]).sum(axis=0))

    def _stack(self, directions: np.ndarray) -> np.ndarray:
        """f' A_K^i for i < s, (s, r, d)."""
        rows = [np.atleast_2d(np.asarray(directions, dtype=float))]
        for _ in range(self.steps - 1):
            rows.append(rows[-1] @ self.closed_loop)
        return np.array(rows)


def outer_mrpi(closed_loop: np.ndarray, W: Supported, accuracy: float = 0.01) -> OuterMrpi:
    """The outer approximation, as many terms as it takes for alpha <= accuracy / (1 + accuracy).

    Args:
        closed_loop: A + BK, (d, d), Schur stable.
        W: the disturbances; the box about 0 that holds them must have an inside.
        accuracy: the set reaches beyond F_inf by at most this share of what the box about W would fill.

    Raises:
        SetError: W's box has no inside, or A + BK is too slow to be summed.
    """
    d = len(closed_loop)
    w = np.maximum(W.support(np.eye(d)), W.support(-np.eye(d)))
    if not (w > 0).all():
        raise SetError(
            f"the outer approximation of the minimal invariant set needs a W with an inside; its half-widths are "
            f"{w.tolist()}. Give each state a small one."
        )
    if np.abs(np.linalg.eigvals(closed_loop)).max() >= 1.0:
        raise SetError("A + BK is not Schur stable: no bounded invariant set exists for any W")
    power = np.eye(d)
    for steps in range(1, MOST_STEPS + 1):
        power = power @ closed_loop
        # A_K^s W inside alpha W, row by row of the box.
        alpha = float((np.abs(power) @ w / w).max())
        if alpha <= accuracy / (1.0 + accuracy):
            return OuterMrpi(closed_loop, W, w, alpha, steps)
    raise SetError(f"A + BK forgets too slowly: not summed within {MOST_STEPS} steps")


@dataclass(frozen=True, eq=False)
class Gain:
    """K (m, d), and how much of X and U F_inf fills: below 1 in every row it fits."""

    K: np.ndarray
    filled: float
    row: str
    """The fullest row."""


def filled(model: Model, K: np.ndarray, X: Polytope, U: Polytope, W: Supported) -> Gain:
    """How much of X and U the minimal invariant set of K fills; infinite where A + BK is not stable."""
    closed = model.A + model.B @ K
    try:
        mrpi = outer_mrpi(closed, W)
    except SetError:
        return Gain(K, np.inf, "stability")
    G_x, g_x = X.one_sided()
    G_u, g_u = U.one_sided()
    shares = mrpi.support(np.vstack([G_x, G_u @ K])) / np.concatenate([g_x, g_u])
    names = [*_sided(X), *_sided(U)]
    worst = int(np.argmax(shares))
    return Gain(K, float(shares[worst]), names[worst])


def search_gain(model: Model, X: Polytope, U: Polytope, W: Supported, starts: int = 4, seed: int = 0) -> Gain:
    """A K whose minimal invariant set fits into X and U, among LQR gains of diagonal weights.

    Nelder and Mead over the logarithms of the weights, from several starts.

    Args:
        X, U: boxes about the equilibrium, deviation coordinates.
        W: the disturbances.
        starts: of the search; the first is from weights of 1 per half-width.
        seed: of the others.

    Raises:
        EmptySetError: none was found; the text says how far the best one is off, and in which row.
    """
    rng = np.random.default_rng(seed)
    d, m = model.d, model.m
    unit = 1.0 / np.concatenate([(X.upper - X.lower) / 2, (U.upper - U.lower) / 2]) ** 2

    def gain(log_weights: np.ndarray) -> Gain:
        weights = np.exp(np.clip(log_weights, -25, 25)) * unit
        q, r = np.diag(weights[:d]), np.diag(weights[d:])
        try:
            s = solve_discrete_are(model.A, model.B, q, r)
            K = -np.linalg.solve(r + model.B.T @ s @ model.B, model.B.T @ s @ model.A)
        except (np.linalg.LinAlgError, ValueError):
            return Gain(np.zeros((m, d)), np.inf, "stability")
        return filled(model, K, X, U, W)

    best = filled(model, model.K, X, U, W)
    for start in range(starts):
        if best.filled < 1.0:
            break
        first = np.zeros(d + m) if start == 0 else rng.normal(scale=4.0, size=d + m)
        result = minimize(
            lambda w: min(gain(w).filled, 1e9), first, method="Nelder-Mead", options={"maxfev": 150 * (d + m)}
        )
        best = min(best, gain(result.x), key=lambda found: found.filled)
    if not best.filled < 1.0:
        raise EmptySetError(
            f"no K was found for which a robust positively invariant set exists in X and U: with the best one the "
            f"disturbance alone fills {best.row} to {best.filled:.2f} of its bound. A smaller W (a smaller region), or "
            "a shorter period would help; a robust control invariant set may exist all the same (tandem sets compute)."
        )
    return best


def _sided(polytope: Polytope) -> list[str]:
    high, low = np.isfinite(polytope.upper), np.isfinite(polytope.lower)
    upper = [f"{name} (upper)" for name, keep in zip(polytope.names, high, strict=True) if keep]
    return upper + [f"{name} (lower)" for name, keep in zip(polytope.names, low, strict=True) if keep]
