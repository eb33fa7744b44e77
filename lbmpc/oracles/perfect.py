"""The oracle that knows h: what learning could reach at best. For experiments, as a floor under the regret.

    h(x, u) = Phi_T(x_e + x, u_e + u) - x_e - A x - B u

Phi_T is the plant's own motion over one period under a constant input, by so many steps of the order-8 method that
integrates the truth.
"""

from __future__ import annotations

import math

import casadi as ca
import numpy as np

from lbmpc.model import Model
from lbmpc.oracles.base import Oracle, OracleState
from lbmpc.plants.base import dop853

STEP_NORM = 0.4
"""At most so much of |a| dt, a the linearisation, in one integration step: h is then right to 1e-9."""
LEAST = 2e-3
"""Of their half-width: states that must stay positive are not let below this in the expression, or a wild plan would
make it NaN."""


class PerfectOracle(Oracle):
    """h_hat = h, with nothing to learn."""

    name = "perfect"
    parameters = 0

    def __init__(self, model: Model):
        self.d, self.m = model.d, model.m
        self._value, self._slopes = _functions(model)

    def split(self, theta: ca.MX) -> list[ca.MX]:
        return []

    def value(self, su: ca.MX, parts: list[ca.MX]) -> ca.MX:
        return self._value.map(su.shape[1])(su)

    def jacobians(self, su: ca.MX, parts: list[ca.MX]) -> list[ca.MX]:
        return ca.horzsplit(self._slopes.map(su.shape[1])(su), self.d + self.m)

    def estimate(self, state: OracleState, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        return np.array(self._value(np.concatenate([x, u])))[:, 0]


def _functions(model: Model) -> tuple[ca.Function, ca.Function]:
    """(x, u), (d + m,), deviations -> h (d,) and its Jacobian (d, d + m)."""
    plant, d = model.plant, model.d
    f = plant.function()
    xu = ca.SX.sym("xu", d + model.m)
    low = np.full(d, -np.inf)
    positive = [domain.state for domain in plant.positive]
    low[positive] = LEAST * plant.x_scale[positive]
    start = ca.fmax(xu[:d] + plant.x_e, low)
    u = xu[d:] + plant.u_e
    steps = max(1, math.ceil(float(np.abs(np.linalg.eigvals(model.a)).max()) * model.period / STEP_NORM))
    after = start
    for _ in range(steps):
        after = dop853(f, after, u, model.period / steps).after
    h = after - plant.x_e - model.A @ xu[:d] - model.B @ xu[d:]
    return ca.Function("h", [xu], [h]), ca.Function("dh", [xu], [ca.jacobian(h, xu)])
