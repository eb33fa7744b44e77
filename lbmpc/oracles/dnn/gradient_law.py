"""The paper's law: the projected, normalised gradient, (e:weight_update_law), and less of it where labels are noisy.

    Kbar_{t+1}^(i) = K_t^(i) - gamma_i phi / |phi|^2 xtilde_i,     K_{t+1}^(i) = Kbar^(i) min(1, Wbar_i / |Kbar^(i)|)
    gamma_i = gamma max(0, 1 - 9 r_i / xtilde_i^2)

with phi = phi_j(x_t, u_t), xtilde_{t+1} = h_hat_t(x_t, u_t) - h(x_t, u_t) and r_i the variance of the label: a dead
zone of three standard deviations. Exact labels, r = 0, take the paper's step to the bit, and Lemma 1 of the paper holds
whenever |phi| >= 1, which the leading 1 of phi guarantees.

**With noise.** For any W* within the bounds, eps = h - W*' phi, V_t = |K_t - W*|_F^2:

    (i)    V_t <= 4 sum Wbar_i^2
    (ii)   V_{t+1} - V_t  <=  sum_i gamma_i / |phi|^2 (eps_i^2 - (1 - gamma_i) xtilde_i^2)
    (iii)  V_{t+1} - V_t  <=  -(1 - gamma) / gamma sum_i (gamma_i xtilde_i)^2 / |phi|^2  where all eps_i^2 <= 9 r_i

Proof of (ii): K_t' phi - W*' phi = xtilde + eps, so that a column moves by gamma_i / |phi|^2 (-2 xtilde_i (xtilde_i +
eps_i) + gamma_i xtilde_i^2), and -2 xtilde_i eps_i <= xtilde_i^2 + eps_i^2; the projection brings nothing farther from
W*. (iii): gamma_i > 0 says eps_i^2 <= 9 r_i = (1 - gamma_i / gamma) xtilde_i^2. So noise within three deviations never
leads away from W*, and what a step still corrects sums to at most gamma / (1 - gamma) V_0.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np

from lbmpc.oracles.dnn.adaptation_law import AdaptationLaw

DEAD_ZONE = 3.0
"""Standard deviations of a label: noise alone passes it in 3 of 1000 labels."""
TINY = 1e-300


@dataclass(frozen=True, eq=False)
class GradientLaw(AdaptationLaw):
    """Nothing is remembered beside K."""

    gamma: float
    """Learning rate, 0 < gamma < 1; 0: K stays as it is."""
    bounds: np.ndarray
    """Wbar_i, (d,), in the units of K' phi."""

    def settings(self) -> dict[str, np.ndarray]:
        return {"gamma": np.array([self.gamma]), "bounds": self.bounds}

    def expression(
        self,
        phi: ca.MX,
        K: ca.MX,
        error: ca.MX,
        variance: ca.MX,
        settings: Mapping[str, ca.MX],
        memory: Mapping[str, ca.MX],
    ) -> dict[str, ca.MX]:
        # 1 exactly where the label is.
        deserved = ca.fmax(0, 1 - DEAD_ZONE**2 * variance / (error * error + TINY))
        moved = K - (settings["gamma"] / ca.dot(phi, phi)) * ((deserved * error) @ phi.T)
        norms, bounds = ca.sqrt(ca.sum2(moved * moved)), settings["bounds"]
        # bounds / bounds is 1 exactly, so what keeps its bound is not touched.
        return {"K": moved * ca.repmat(bounds / ca.fmax(norms, bounds), 1, K.shape[1])}
