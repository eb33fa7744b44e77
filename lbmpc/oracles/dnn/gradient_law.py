"""The paper's law: the projected, normalised gradient, (e:weight_update_law).

    Kbar_{t+1} = K_t - gamma phi / |phi|^2 xtilde_{t+1}',     K_{t+1}^(i) = Kbar^(i) min(1, Wbar_i / |Kbar^(i)|)

with phi = phi_j(x_t, u_t) and xtilde_{t+1} = h_hat_t(x_t, u_t) - h(x_t, u_t). Lemma 1 of the paper holds for it
whenever |phi| >= 1, which the leading 1 of phi guarantees.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np

from lbmpc.oracles.dnn.adaptation_law import AdaptationLaw


NOISE = 9.0
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
        deserved = ca.fmax(0, 1 - NOISE * variance / (error * error + TINY))
        moved = K - (settings["gamma"] / ca.dot(phi, phi)) * ((deserved * error) @ phi.T)
        norms, bounds = ca.sqrt(ca.sum2(moved * moved)), settings["bounds"]
        # bounds / bounds is 1 exactly, so what keeps its bound is not touched.
        return {"K": moved * ca.repmat(bounds / ca.fmax(norms, bounds), 1, K.shape[1])}
