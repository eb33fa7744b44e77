"""The L2-regularised Nadaraya-Watson estimator of Aswani et al. (2013), the paper's baseline.

    h_hat(xi) = sum_i k_i h_i / (lambda + sum_i k_i),    k_i = valid_i exp(-|xi - xi_i|^2 / (2 b^2))

over a window of the newest samples. The window has a fixed size, so it can be a parameter. A validity mask removes
unused slots from both sums; otherwise they would bias the estimate towards zero.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from lbmpc.oracles.base import Oracle, OracleState, Variance, by_point


class L2nwOracle(Oracle):
    """Kernel regression on a subset of states and inputs.

    Args:
        d, m: numbers of states and inputs.
        variables: indices into (x, u) that are arguments of the kernel.
        window: number of stored samples.
        bandwidth: b of each variable, (n,), in its units, or one number for all.
        regularisation: lambda.
    """

    name = "l2nw"

    def __init__(
        self,
        d: int,
        m: int,
        variables: tuple[int, ...],
        window: int,
        bandwidth: np.ndarray | float,
        regularisation: float,
    ):
        self.d, self.m, self.variables = d, m, variables
        self.window, self.regularisation = window, regularisation
        self.bandwidth = np.broadcast_to(bandwidth, len(variables))
        # theta, column-major: kernel inputs (n, window), labels (d, window), validity (1, window).
        self.rows = len(variables) + d + 1
        self.parameters = self.rows * window

    def split(self, theta: ca.MX) -> list[ca.MX]:
        n = len(self.variables)
        table = ca.reshape(theta, self.rows, self.window)
        return [table[:n, :].T, table[n : n + self.d, :], table[n + self.d, :].T]

    def value(self, su: ca.MX, parts: list[ca.MX]) -> ca.MX:
        return self._value_and_slopes(su, parts)[0]

    def jacobians(self, su: ca.MX, parts: list[ca.MX]) -> list[ca.MX]:
        slopes = self._value_and_slopes(su, parts)[1]
        zero = ca.MX.zeros(self.d, su.shape[1])
        return by_point(
            [slopes[self.variables.index(k)] if k in self.variables else zero for k in range(self.d + self.m)]
        )

    def _value_and_slopes(self, xu: ca.MX, parts: list[ca.MX]) -> tuple[ca.MX, list[ca.MX]]:
        points, labels, valid = parts
        offsets = []
        squared = ca.MX.zeros(self.window, xu.shape[1])
        for row, k in enumerate(self.variables):
            # (window, points): each sample against each point.
            offset = ca.repmat(xu[k, :], self.window, 1) - ca.repmat(points[:, row], 1, xu.shape[1])
            offset /= self.bandwidth[row]
            offsets.append(offset)
            squared += offset**2
        weights = ca.repmat(valid, 1, xu.shape[1]) * ca.exp(-squared / 2)
        total = ca.repmat(self.regularisation + ca.sum1(weights), self.d, 1)
        h = (labels @ weights) / total
        slopes = []
        for row, offset in enumerate(offsets):
            weight_slope = -weights * offset / self.bandwidth[row]
            slopes.append((labels @ weight_slope - h * ca.repmat(ca.sum1(weight_slope), self.d, 1)) / total)
        return h, slopes

    def initial_state(self, rng: np.random.Generator) -> OracleState:
        return {"window": np.zeros((self.window, self.rows)), "next": np.zeros(1, dtype=np.int64)}

    def theta(self, state: OracleState) -> np.ndarray:
        return state["window"].ravel()

    def estimate(self, state: OracleState, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        n = len(self.variables)
        table = state["window"]
        distance = (table[:, :n] - np.concatenate([x, u])[list(self.variables)]) / self.bandwidth
        weights = table[:, -1] * np.exp(-(distance**2).sum(axis=1) / 2)
        return weights @ table[:, n : n + self.d] / (self.regularisation + weights.sum())

    def learn(
        self, state: OracleState, x: np.ndarray, u: np.ndarray, h: np.ndarray, variance: Variance = 0.0
    ) -> OracleState:
        window, position = state["window"].copy(), int(state["next"][0])
        window[position] = np.concatenate([np.concatenate([x, u])[list(self.variables)], h, [1.0]])
        return {"window": window, "next": np.array([(position + 1) % self.window], dtype=np.int64)}
