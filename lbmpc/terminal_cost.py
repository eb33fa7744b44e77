"""The terminal cost |z_N|_P^2 of (e:LBMPC): which P, and whether it bounds what comes after the horizon.

With the stage weights Q and R of one period T, P is named:

    riccati      P = A'PA - A'PB (R + B'PB)^-1 B'PA + Q         the least cost of the nominal model without bounds
    lyapunov     P = (A + BK)'P(A + BK) + Q + K'RK              the nominal cost of v = K x
    published    riccati of (A + BK, B) with Q / T and R / T    the reimplementation of Aswani et al. (2013), where the
                                                                terminal cost is not multiplied by T

The theory asks of each that some gain K_f pays for every further stage out of P:

    P - A_f'P A_f >= Q + K_f'R K_f,    A_f = A + B K_f.

For `lyapunov` that gain is K. For the others it is the LQR gain of P, K_f = -(R + B'PB)^-1 B'PA, which loses least.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from scipy.linalg import solve_discrete_are, solve_discrete_lyapunov

TerminalCost = Literal["riccati", "lyapunov", "published"]
TOLERANCE = 1e-6
"""What the condition may miss by for rounding, as a share of P, in units of the half-widths."""


def terminal_cost(
    kind: TerminalCost,
    A: np.ndarray,
    B: np.ndarray,
    Q: np.ndarray,
    R: np.ndarray,
    K: np.ndarray,
    period: float,
) -> tuple[np.ndarray, np.ndarray]:
    """P (d, d), symmetric, and the gain K_f (m, d) that belongs to it.

    Args:
        kind: the equation for P, as above.
        A, B: of the discrete-time model, (d, d) and (d, m).
        Q, R: stage weights, (d, d) and (m, m).
        K: feedback with A + BK Schur stable, (m, d).
        period: T in seconds.

    Raises:
        numpy.linalg.LinAlgError: the equation has no solution in these numbers.
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
    """By how much P misses the condition, or being positive, as a share of itself; `scale` (d,): units of x.

    At most `TOLERANCE` where only rounding is missing.
    """
    A_f, units = A + B @ K_f, np.outer(scale, scale)
    decrease = P - A_f.T @ P @ A_f - Q - K_f.T @ R @ K_f
    least = min(np.linalg.eigvalsh(_symmetric(part * units)).min() for part in (decrease, P))
    size = np.linalg.norm(P * units, 2)
    return float(-least / size) if size > 0.0 else 0.0


def _symmetric(matrix: np.ndarray) -> np.ndarray:
    return 0.5 * (matrix + matrix.T)
