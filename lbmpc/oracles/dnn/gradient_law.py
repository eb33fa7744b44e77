"""The paper's law: the projected, normalised gradient (e:weight_update_law), with a dead zone for noisy labels.

    Kbar_{t+1}^(i) = K_t^(i) - gamma_i phi / |phi|^2 xtilde_i,     K_{t+1}^(i) = Kbar^(i) min(1, Wbar_i / |Kbar^(i)|)
    gamma_i = gamma max(0, 1 - 9 r_i / xtilde_i^2)

with phi = phi_j(x_t, u_t), xtilde_{t+1} = h_hat_t(x_t, u_t) - h(x_t, u_t) and r_i the variance of the label. The dead
zone has a width of three standard deviations. For exact labels, r = 0, the step is exactly the paper's, and Lemma 1 of
the paper holds whenever |phi| >= 1, which the leading 1 of phi guarantees.

**With noise.** For any W* within the bounds, eps = h - W*' phi, V_t = |K_t - W*|_F^2:

    (i)    V_t <= 4 sum Wbar_i^2
    (ii)   V_{t+1} - V_t  <=  sum_i gamma_i / |phi|^2 (eps_i^2 - (1 - gamma_i) xtilde_i^2)
    (iii)  V_{t+1} - V_t  <=  -(1 - gamma) / gamma sum_i (gamma_i xtilde_i)^2 / |phi|^2  where all eps_i^2 <= 9 r_i

Proof of (ii): K_t' phi - W*' phi = xtilde + eps, so a column changes V by gamma_i / |phi|^2 (-2 xtilde_i (xtilde_i +
eps_i) + gamma_i xtilde_i^2), and -2 xtilde_i eps_i <= xtilde_i^2 + eps_i^2. The projection does not increase the
distance from W*. (iii): gamma_i > 0 implies eps_i^2 <= 9 r_i = (1 - gamma_i / gamma) xtilde_i^2. Noise within three
standard deviations therefore never increases V, and the corrections sum to at most gamma / (1 - gamma) V_0.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np

from lbmpc.oracles.dnn.adaptation_law import AdaptationLaw

DEAD_ZONE = 3.0
"""Standard deviations of a label. Noise alone exceeds it in 3 of 1000 labels."""
TINY = 1e-300


@dataclass(frozen=True, eq=False)
class GradientLaw(AdaptationLaw):
    """The gradient law. It has no memory beside K."""

    gamma: float
    """Learning rate, 0 < gamma < 1; 0 keeps K constant."""
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
        # This is exactly 1 for an exact label.
        deserved = ca.fmax(0, 1 - DEAD_ZONE**2 * variance / (error * error + TINY))
        moved = K - (settings["gamma"] / ca.dot(phi, phi)) * ((deserved * error) @ phi.T)
        norms, bounds = ca.sqrt(ca.sum2(moved * moved)), settings["bounds"]
        # bounds / bounds is exactly 1, so a column within its bound does not change.
        return {"K": moved * ca.repmat(bounds / ca.fmax(norms, bounds), 1, K.shape[1])}
