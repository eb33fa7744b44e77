"""The last layer as Bayesian linear regression: a Kalman filter for its weights, projected in its own norm.

Every label is h = K' phi with an error of variance r, in units of the output scale. The variance is the same for all
columns of K, so they share one covariance Sigma. r_t below is the configured variance r, which covers the error of the
features, plus the largest variance of the label; it is at least r.

    s_t = r_t + phi' Sigma_t phi
    Kbar_{t+1} = K_t - Sigma_t phi xtilde_{t+1}' / s_t,    Sigmabar_{t+1} = Sigma_t - Sigma_t phi phi' Sigma_t / s_t
    Sigma_{t+1} = a Sigmabar_{t+1} + (1 - a) p I,          Sigma_0 = p I
    K_{t+1}^(i) = argmin (k - Kbar^(i))' Sigma_{t+1}^-1 (k - Kbar^(i))   over   |k| <= Wbar_i

Past information decays towards the prior p I, with a < 1, so that changes of the plant or of the features are followed.
The decay also keeps Sigma above (1 - a) p I, so rounding cannot make it indefinite.

**Counterpart of Lemma 1.** For any W* with |W*^(i)| <= Wbar_i and any features, also those of changing hidden layers,
let eps_t = h(x_t, u_t) - W*' phi and V_t = trace (K_t - W*)' Sigma_t^-1 (K_t - W*). Then

    (i)    s_t <= r_t + p |phi|^2
    (ii)   V_{t+1} - V_t <= |eps_t|^2 / r_t - |xtilde_{t+1}|^2 / s_t
    (iii)  sum |xtilde_{t+1}|^2 / s_t  <=  V_0 + sum |eps_t|^2 / r_t,     V_0 = |K_0 - W*|_F^2 / p <= 4 sum Wbar_i^2 / p

Proof. Completing the square in k, with Sigmabar^-1 = Sigma_t^-1 + phi phi' / r_t, gives for each column

    (k - k_t)' Sigma_t^-1 (k - k_t) + (h - k' phi)^2 / r_t  =  (k - kbar)' Sigmabar^-1 (k - kbar) + xtilde^2 / s_t.

At k = W* the first term is V_t, the second |eps|^2 / r_t, and the third V of Kbar in the norm of Sigmabar^-1. From
Sigmabar <= Sigma_t <= p I follows Sigmabar <= Sigma_{t+1} <= p I, hence (i), and the norm of Sigma_{t+1}^-1 is not
larger. In that norm, projection onto a convex set that contains W* does not increase the distance from W*, hence (ii).
The sum over t is (iii).

The result remains true when hidden layers are adopted, because K and Sigma are kept.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np

from lbmpc.oracles.base import OracleState
from lbmpc.oracles.dnn.adaptation_law import AdaptationLaw

NEWTON, CLOSE = 100, 1e-13


@dataclass(frozen=True)
class Kalman:
    """The filter's numbers. Variances are in units of the output scale squared."""

    prior_variance: float
    """p, the variance of each entry of K before the first sample."""
    label_variance: float
    """r, the variance of each entry of a label in addition to the label's own variance."""
    kept: float
    """a, the share of past information that is kept per sample, 0 < a < 1."""


@dataclass(frozen=True, eq=False)
class KalmanLaw(AdaptationLaw):
    """The Kalman law. Its memory beside K is Sigma, (f, f)."""

    filter: Kalman
    bounds: np.ndarray
    """Wbar_i, (d,), in the units of K' phi."""
    remembers = ("Sigma",)

    def begin(self, features: int) -> OracleState:
        return {"Sigma": self.filter.prior_variance * np.eye(features)}

    def settings(self) -> dict[str, np.ndarray]:
        chosen = self.filter
        faded = (1.0 - chosen.kept) * chosen.prior_variance
        return {
            "label_variance": np.array([chosen.label_variance]),
            "kept": np.array([chosen.kept]),
            "faded": np.array([faded]),
        }

    def expression(
        self,
        phi: ca.MX,
        K: ca.MX,
        error: ca.MX,
        variance: ca.MX,
        settings: Mapping[str, ca.MX],
        memory: Mapping[str, ca.MX],
    ) -> dict[str, ca.MX]:
        Sigma = memory["Sigma"]
        along = Sigma @ phi
        s = settings["label_variance"] + ca.mmax(variance) + ca.dot(phi, along)
        # The product of a vector with itself is exactly symmetric, so Sigma stays exactly symmetric.
        root = along / ca.sqrt(s)
        less = settings["kept"] * (Sigma - root @ root.T)
        return {
            "K": K - error @ (along / s).T,
            "Sigma": less + settings["faded"] * ca.DM.eye(phi.shape[0]),
        }

    def bounded(self, learned: OracleState) -> OracleState:
        K = learned["K"]
        if ((K * K).sum(axis=0) <= self.bounds**2).all():
            return learned
        return {**learned, "K": nearest_within(K, learned["Sigma"], self.bounds)}


def nearest_within(K: np.ndarray, Sigma: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    """Project every column of K, (f, d), onto its bound, (d,), in the norm of Sigma^-1.

        k = (I + lambda Sigma)^-1 kbar,    |k| = bound

    The equation for lambda > 0 is that of a trust region (Moré and Sorensen 1983). Newton's method on 1 / |k|
    approaches the root from the left and does not pass it.

    Args:
        K: columns within their bounds are not changed.
        Sigma: symmetric and positive definite, (f, f).
        bounds: Wbar_i, (d,).
    """
    variances, axes = np.linalg.eigh(Sigma)
    variances = np.maximum(variances, np.finfo(float).eps * variances[-1])
    nearest = K.copy()
    for i in np.flatnonzero(np.sqrt((K * K).sum(axis=0)) > bounds):
        turned, bound, multiplier = axes.T @ K[:, i], bounds[i], 0.0
        for _ in range(NEWTON):
            shrunk = turned / (1.0 + multiplier * variances)
            norm = float(np.sqrt(shrunk @ shrunk))
            if norm <= bound * (1.0 + CLOSE):
                break
            slope = shrunk @ (shrunk * variances / (1.0 + multiplier * variances))
            multiplier += (norm / bound - 1.0) * norm**2 / slope
        # The remaining difference is rounding.
        nearest[:, i] = axes @ shrunk * min(1.0, bound / norm)
    return nearest
