"""The oracle of plain linear MPC, which does not learn."""

from __future__ import annotations

import casadi as ca
import numpy as np

from lbmpc.oracles.base import Oracle, OracleState, by_point


class LinearOracle(Oracle):
    """h_hat = 0: plain linear MPC. With `pairs` > 1 it replaces an oracle with a window, and ignores the window."""

    name = "linear"
    parameters = 0

    def __init__(self, d: int, m: int, pairs: int = 1):
        self.d, self.m, self.pairs = d, m, pairs

    def split(self, theta: ca.MX) -> list[ca.MX]:
        return []

    def value(self, su: ca.MX, parts: list[ca.MX]) -> ca.MX:
        return ca.MX.zeros(self.d, su.shape[1])

    def jacobians(self, su: ca.MX, parts: list[ca.MX]) -> list[ca.MX]:
        return by_point([ca.MX.zeros(self.d, su.shape[1]) for _ in range(su.shape[0])])

    def estimate(self, state: OracleState, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        return np.zeros(self.d)
