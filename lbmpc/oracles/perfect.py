"""The oracle that knows h, for experiments. It is the best case of learning and a lower bound of the regret.

    h(x, u) = Phi_T(x_e + x, u_e + u) - x_e - A x - B u

Phi_T is the true plant's motion over one period under a constant input, computed by steps of the order-8 method that
also integrates the truth. A and B are those of the nominal model, even if it is wrong. The true plant's parameters are
theta, so a plant that changes is followed without rebuilding.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import casadi as ca
import numpy as np

from lbmpc.model import Model
from lbmpc.oracles.base import Oracle, OracleState
from lbmpc.plants.description import PlantError
from lbmpc.plants.equations import Plant
from lbmpc.plants.truth import dop853

STEP_NORM = 0.4
"""Upper limit of |a| dt per integration step, with a the linearisation. The error of h is then 1e-9."""
MOST_STEPS = 400
"""Upper limit of integration steps per period. A faster plant would need too much memory."""
LEAST = 2e-3
"""Share of the half-width. The expression keeps positive states above it, so that a bad plan does not give NaN."""


class PerfectOracle(Oracle):
    """An oracle with h_hat = h that has nothing to learn.

    Args:
        model: the nominal model, with the A and B in the definition of h.
        truth: the true plant; None for the equations that the model is linearised from.

    Raises:
        ModelError: `truth` is None and the model is given by numbers alone.
        PlantError: the true plant is too fast to be predicted over a period.
    """

    name = "perfect"

    def __init__(self, model: Model, truth: Plant | None = None):
        self.d, self.m = model.d, model.m
        self._truth = model.require_equations("the oracle perfect") if truth is None else truth
        self._names = list(self._truth.parameters)
        self.parameters = len(self._names)
        self._value, self._slopes = _functions(model, self._truth)

    def split(self, theta: ca.MX) -> list[ca.MX]:
        return [theta]

    def value(self, su: ca.MX, parts: list[ca.MX]) -> ca.MX:
        return self._value.map(su.shape[1])(su, ca.repmat(parts[0], 1, su.shape[1]))

    def jacobians(self, su: ca.MX, parts: list[ca.MX]) -> list[ca.MX]:
        slopes = self._slopes.map(su.shape[1])(su, ca.repmat(parts[0], 1, su.shape[1]))
        return ca.horzsplit(slopes, self.d + self.m)

    def initial_state(self, rng: np.random.Generator) -> OracleState:
        return {"parameters": np.array(list(self._truth.parameters.values()), dtype=float)}

    def theta(self, state: OracleState) -> np.ndarray:
        return state["parameters"]

    def estimate(self, state: OracleState, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        return np.array(self._value(np.concatenate([x, u]), state["parameters"]))[:, 0]

    def told(self, state: OracleState, truth: Mapping[str, float]) -> OracleState:
        before = zip(self._names, state["parameters"].tolist(), strict=True)
        return {"parameters": np.array([truth.get(name, value) for name, value in before])}


def _functions(model: Model, truth: Plant) -> tuple[ca.Function, ca.Function]:
    """Build (x, u), (d + m,), in deviations, and the parameters -> h (d,) and its Jacobian (d, d + m)."""
    plant, d = model.plant, model.d
    xu, parameters = ca.SX.sym("xu", d + model.m), ca.SX.sym("parameters", len(truth.parameters))
    low = np.full(d, -np.inf)
    positive = [domain.state for domain in truth.positive]
    low[positive] = LEAST * plant.x_scale[positive]
    start = ca.fmax(xu[:d] + plant.x_e, low)
    u = xu[d:] + plant.u_e
    steps = _steps(truth, model.period)
    f = truth.function_of_parameters()
    after = start
    for _ in range(steps):
        after = dop853(lambda x, u: f(x, u, parameters), after, u, model.period / steps).after
    h = after - plant.x_e - model.A @ xu[:d] - model.B @ xu[d:]
    inputs = [xu, parameters]
    return ca.Function("h", inputs, [h]), ca.Function("dh", inputs, [ca.jacobian(h, xu)])


def _steps(truth: Plant, period: float) -> int:
    """Return the number of integration steps per period."""
    slopes = truth.linearised()[1]
    turns = float(np.abs(np.linalg.eigvals(slopes)).max()) * period if np.isfinite(slopes).all() else math.inf
    if not turns <= MOST_STEPS * STEP_NORM:
        raise PlantError(
            f"{truth.name}: its true motion is too fast to be predicted over a period of {period:g} s"
        )
    return max(1, math.ceil(turns / STEP_NORM))
