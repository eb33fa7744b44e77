"""Prediction over part of a period by the plant's own equations, dx/dt = f(x, u) with constant u.

The certified sets apply to the state at which a command begins to act. The prediction of that state decides about the
certificate, so it uses the equations of the sets and not an oracle.

If W is given, there may be no equations. The linear motion is used instead, and the sets apply to the predicted state.
With Phi, Gamma over the delay, and h the error of the model from sample to sample for any input in between,

    y = Phi x + Gamma u_before,      y+ = A y + B u + Phi h,

so W of the predicted states is Phi W. `over_any_delay` covers all of them.
"""

from __future__ import annotations

import math
from typing import Protocol

import casadi as ca
import numpy as np

from lbmpc.casadi_buffers import Bound
from lbmpc.model import Model
from lbmpc.plants.equations import Plant
from lbmpc.plants.linear_motion import Continuous, discretise
from lbmpc.sets.certificate import Certificate, CertificateError

LATEST = 0.5
"""Share of a period. The longest delay that is predicted."""
DELAYS = 65
"""Number of delays that `over_any_delay` evaluates, from zero to the longest."""

STEP_NORM = 0.06
"""Upper limit of |a| dt per Runge-Kutta step over a period, with a the linearisation. The error is 2e-7 of X's
half-widths over a period, and 1e-8 over half a period."""
MOST_STEPS = 1000
"""Upper limit for a plant that is stiff relative to its period. The result is then less accurate or not finite."""


class Motion(Protocol):
    """Prediction of the state up to one period ahead, in deviation coordinates."""

    def after(self, x: np.ndarray, u: np.ndarray, seconds: float) -> np.ndarray | None:
        """Return the state, (d,), `seconds` after x, (d,), under the input u, (m,).

        The result is None if the motion leaves the domain of the equations or is not finite.
        """
        ...


def motion_of(model: Model, certificate: Certificate) -> Motion:
    """Return the motion by the plant's equations, or the linear motion for sets of a given W.

    Raises:
        ModelError: the sets were computed from equations, and the model has none.
    """
    if certificate.source_of_W == "given":
        return OfNumbers(model)
    return OfEquations(
        model, model.require_equations("the prediction over the delay, which these sets require,")
    )


def over_any_delay(model: Model, W: np.ndarray) -> np.ndarray:
    """Return half-widths, (d,), of a box that contains Phi w for every w of the box W, (d,), and delays up to `LATEST`.

    Raises:
        CertificateError: the model's motion within a period is not known.
    """
    within = require_prediction(model)
    seconds = np.linspace(0.0, LATEST * model.period, DELAYS).tolist()
    moved = [np.abs(discretise(within.a, within.b, one, within.units)[0]) @ W for one in seconds]
    return np.asarray(np.max(moved, axis=0))


def require_prediction(model: Model) -> Continuous:
    """Return the linear motion within a period. Raises `CertificateError` if it is not known."""
    within = model.within
    if not isinstance(within, Continuous):
        raise CertificateError(
            f"{model.plant.name}: its A and B are in discrete time and give no motion between two samples, so the "
            "state at which a command begins to act cannot be predicted. Certified sets need equations, A and B in "
            "continuous time, or an A without negative or zero eigenvalues"
        )
    return within


def require_certifiable(model: Model) -> None:
    """Raise `CertificateError` if the plant has a dead time or rows besides its boxes.

    The effect of h until a command acts is not bounded here, and a certificate describes X and U as boxes.
    """
    if model.plant.rows:
        raise CertificateError(
            f"{model.plant.name}: certified sets need X and U as boxes, but there are other rows "
            f"({', '.join(model.plant.rows)}): remove them, or use another controller.tightening"
        )
    if model.plant.dead_time:
        raise CertificateError(
            f"{model.plant.name}: certified sets apply to the state at which a command acts, and over a dead time of "
            f"{model.plant.dead_time:g} s its prediction is not accurate enough: use another controller.tightening"
        )


class OfNumbers:
    """Prediction by the linear motion."""

    def __init__(self, model: Model):
        self._model = model

    def after(self, x: np.ndarray, u: np.ndarray, seconds: float) -> np.ndarray | None:
        found = self._model.ahead(x, u, seconds)
        return found if np.isfinite(found).all() else None


class OfEquations:
    """Prediction by integration of dx/dt = f(x, u)."""

    def __init__(self, model: Model, plant: Plant):
        norm = float(np.abs(np.linalg.eigvals(plant.linearised()[1])).max()) * model.period
        steps = min(max(1, math.ceil(norm / STEP_NORM)), MOST_STEPS)
        x, u, seconds = ca.MX.sym("x", model.d), ca.MX.sym("u", model.m), ca.MX.sym("seconds")
        # CasADi's classical method of order 4. DOP853 would add half a second of importing scipy at the start.
        step = ca.simpleRK(plant.function(), steps, 4)
        after = step(x + plant.x_e, u + plant.u_e, seconds) - plant.x_e
        self._after = Bound(
            ca.Function("motion", [x, u, seconds], [after], ["x", "u", "seconds"], ["after"]).expand()
        )

    def after(self, x: np.ndarray, u: np.ndarray, seconds: float) -> np.ndarray | None:
        function = self._after
        function.inputs["x"][:, 0], function.inputs["u"][:, 0] = x, u
        function.inputs["seconds"][0, 0] = seconds
        function()
        found = function.outputs["after"][:, 0].copy()
        return found if np.isfinite(found).all() else None
