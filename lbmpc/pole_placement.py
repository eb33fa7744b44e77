"""K from closed-loop poles for one input, by the method of Kautsky, Nichols and Van Dooren.

    A + BK = X diag(p) X^-1,    X's column i spans the kernel of U1'(A - p_i I),    B = (U0 U1) (z; 0)

With one input the solution is unique, and this code is complete. `scipy.signal.place_poles` gives exactly the same
result and also covers several inputs. Its import takes 0.9 s, which is as long as the whole start of a controller up
to its first tick (median of 15 processes each).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.linalg import qr


def place(A: np.ndarray, B: np.ndarray, poles: Sequence[complex]) -> np.ndarray:
    """Return K, (m, d), such that A + BK has these d eigenvalues; complex ones must be in conjugate pairs.

    Raises:
        ValueError: the number of poles is wrong, they are not in pairs or repeated, or they cannot be placed.
    """
    d, m = B.shape
    if m > 1 or d == 1:
        # This import takes a second and is needed for such plants only.
        from scipy.signal import place_poles

        return np.asarray(-place_poles(A, B, poles).gain_matrix)
    p = _ordered(poles, d)
    u, z = qr(B)
    u0, u1 = u[:, :1], u[:, 1:]
    # X is complex even for real poles, to have the same rounding as scipy.
    X = np.column_stack([_kernel(u1.T @ (A - pole * np.eye(d))) for pole in p]).astype(complex)
    try:
        closed = np.linalg.solve(X.T, np.diag(p) @ X.T).T
        return np.real(np.linalg.solve(z[:1], u0.T @ (closed - A)))
    except np.linalg.LinAlgError as error:
        raise ValueError(f"the poles {_words(p)} cannot be placed: {error}") from error


def _ordered(poles: Sequence[complex], d: int) -> np.ndarray:
    """Return the poles with real ones first, then the pairs, (d,)."""
    given = np.asarray(poles)
    if len(given) != d:
        raise ValueError(f"{len(given)} poles are given, {d} are needed: {_words(given)}")
    if len(set(given.tolist())) < d:
        raise ValueError(f"with one input all poles must be different: {_words(given)}")
    pairs = [q for p in np.sort(given[np.imag(given) < 0]) if np.conj(p) in given for q in (p, np.conj(p))]
    ordered = np.hstack([np.sort(given[np.isreal(given)]), pairs])
    if len(ordered) != d:
        raise ValueError(f"complex poles must come with their conjugates: {_words(given)}")
    return ordered


def _kernel(rows: np.ndarray) -> np.ndarray:
    """Return a unit vector, (d,), in the kernel of these d - 1 rows."""
    q, _ = qr(rows.T)
    return np.conj(q[:, -1]) / np.linalg.norm(q[:, -1])


def _words(poles: np.ndarray) -> str:
    return ", ".join(f"{pole:.6g}" for pole in poles.tolist())
