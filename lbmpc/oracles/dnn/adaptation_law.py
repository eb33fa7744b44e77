"""The fast timescale: the projected, normalised gradient law for the last layer, (e:weight_update_law).

    Kbar_{t+1} = K_t - gamma phi / |phi|^2 xtilde_{t+1}',     K_{t+1}^(i) = Kbar^(i) min(1, Wbar_i / |Kbar^(i)|)

with phi = phi_j(x_t, u_t) and xtilde_{t+1} = h_hat_t(x_t, u_t) - h(x_t, u_t). Lemma 1 of the paper holds for it
whenever |phi| >= 1, which the leading 1 of phi guarantees.
"""

from __future__ import annotations

import numpy as np


def project_columns(K: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    """Scale every column of K, (n, d), whose Euclidean norm exceeds its bound, (d,), back onto it."""
    norms = np.sqrt((K * K).sum(axis=0))
    # A norm below its bound needs no division, and zero could not stand one.
    return K * np.where(norms > bounds, bounds / np.where(norms > bounds, norms, 1.0), 1.0)


def refit(K: np.ndarray, phi: np.ndarray, h: np.ndarray, ridge: float, bounds: np.ndarray) -> np.ndarray:
    """The output weights that explain n samples best under new features, then projected.

        argmin over K'    |phi K' - h|^2 / n + ridge |K' - K|^2

    The ridge holds what the samples say nothing about where it was.

    Args:
        K: output weights before, (f, d).
        phi: features of the samples, (n, f).
        h: their labels, (n, d), in the units of K' phi.
        ridge: above 0.
        bounds: Wbar_i, (d,), in the same units.

    Returns:
        (f, d).
    """
    samples, features = phi.shape
    gram = phi.T @ phi / samples + ridge * np.eye(features)
    return project_columns(K + np.linalg.solve(gram, phi.T @ (h - phi @ K) / samples), bounds)
