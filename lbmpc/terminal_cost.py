"""The terminal cost |z_N|_P^2 of (e:LBMPC): the choice of P, and the check that it bounds the cost after the horizon.

With the stage weights Q and R of one period T, the choices of P are:

    riccati      P = A'PA - A'PB (R + B'PB)^-1 B'PA + Q         the least cost of the nominal model without bounds
    lyapunov     P = (A + BK)'P(A + BK) + Q + K'RK              the nominal cost of v = K x
    published    riccati of (A + BK, B) with Q / T and R / T    the reimplementation of Aswani et al. (2013), where the
                                                                terminal cost is not multiplied by T

The theory requires a gain K_f such that P decreases by at least the cost of each further stage:

    P - A_f'P A_f >= Q + K_f'R K_f,    A_f = A + B K_f.

For `lyapunov` that gain is K. For the others it is the LQR gain of P, K_f = -(R + B'PB)^-1 B'PA, the best choice.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from scipy.linalg import solve_discrete_are, solve_discrete_lyapunov

TerminalCost = Literal["riccati", "lyapunov", "published"]
TOLERANCE = 1e-6
"""Rounding error of the condition that is accepted, as a share of P, in units of the half-widths."""


def terminal_cost(
    kind: TerminalCost,
    A: np.ndarray,
    B: np.ndarray,
    Q: np.ndarray,
    R: np.ndarray,
    K: np.ndarray,
    period: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Return P (d, d), symmetric, and its gain K_f (m, d).

    Args:
        kind: the equation for P, as above.
        A, B: matrices of the discrete-time model, (d, d) and (d, m).
        Q, R: stage weights, (d, d) and (m, m).
        K: feedback with A + BK Schur stable, (m, d).
        period: T in seconds.

    Raises:
        numpy.linalg.LinAlgError: the equation has no solution for these numbers.
    """
    if kind == "lyapunov":
        P = solve_discrete_lyapunov((A + B @ K).T, Q + K.T @ R @ K)
        return _symmetric(P), K
    if kind == "riccati":
        P = solve_discrete_are(A, B, Q, R)
    else:
        P = solve_discrete_are(A + B @ K, B, Q / period, R / period)
    return _symmetric(P), -np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)


def shortfall(
    P: np.ndarray,
    K_f: np.ndarray,
    A: np.ndarray,
    B: np.ndarray,
    Q: np.ndarray,
    R: np.ndarray,
    scale: np.ndarray,
) -> float:
    """Return the relative violation of the condition and of P >= 0 by P; `scale` (d,) are the units of x.

    Up to `TOLERANCE` the violation counts as rounding.
    """
    A_f, units = A + B @ K_f, np.outer(scale, scale)
    decrease = P - A_f.T @ P @ A_f - Q - K_f.T @ R @ K_f
    least = min(np.linalg.eigvalsh(_symmetric(part * units)).min() for part in (decrease, P))
    size = np.linalg.norm(P * units, 2)
    return float(-least / size) if size > 0.0 else 0.0


def _symmetric(matrix: np.ndarray) -> np.ndarray:
    return 0.5 * (matrix + matrix.T)
