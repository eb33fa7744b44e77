"""An oracle that learns one number per state, as classical offset-free MPC does.

    h_hat_{t+1} = h_hat_t + gain (h(x_t, u_t) - h_hat_t),    h_hat_0 = 0

h_hat is constant over X x U. At rest it equals the disturbance, so the prediction error vanishes (Pannocchia and
Rawlings 2003). With a reference (`lbmpc.targets`) there is no offset. The oracle is the baseline for those that learn a
function.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from lbmpc.oracles.base import Oracle, OracleState, Variance, by_point


class ConstantOracle(Oracle):
    """An oracle whose h_hat is the filtered label.

    Args:
        d, m: numbers of states and inputs.
        gain: share of a new label, above 0 and at most 1. With 1, h_hat is the last label.
    """

    name = "constant"

    def __init__(self, d: int, m: int, gain: float):
        self.d, self.m, self.gain = d, m, gain
        self.parameters = d

    def split(self, theta: ca.MX) -> list[ca.MX]:
        return [theta]

    def value(self, su: ca.MX, parts: list[ca.MX]) -> ca.MX:
        return ca.repmat(parts[0], 1, su.shape[1])

    def jacobians(self, su: ca.MX, parts: list[ca.MX]) -> list[ca.MX]:
        return by_point([ca.MX.zeros(self.d, su.shape[1]) for _ in range(su.shape[0])])

    def initial_state(self, rng: np.random.Generator) -> OracleState:
        return {"h_hat": np.zeros(self.d)}

    def theta(self, state: OracleState) -> np.ndarray:
        return state["h_hat"]

    def estimate(self, state: OracleState, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        return state["h_hat"]

    def learn(
        self, state: OracleState, x: np.ndarray, u: np.ndarray, h: np.ndarray, variance: Variance = 0.0
    ) -> OracleState:
        # This form gives h exactly for a gain of 1.
        return {"h_hat": (1.0 - self.gain) * state["h_hat"] + self.gain * h}
