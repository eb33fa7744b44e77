"""Where the plant is a part of a period later, by its own equations: dx/dt = f(x, u), u constant.

The sets are about the state in which a command begins to act. What predicts that state decides what is certified, so
it is no oracle's guess: the equations are those that the sets were computed for.

Where W is given there may be no equations. Then the linear motion says it, and the sets are about the state that is
predicted. With Phi, Gamma over the delay and h what the model misses from sample to sample, whatever acted in between,

    y = Phi x + Gamma u_before,      y+ = A y + B u + Phi h,

so W of the predicted states is Phi W. `over_any_delay` is what holds all of them.
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
"""Of a period: the longest delay that is predicted over."""
DELAYS = 65
"""At which `over_any_delay` looks, from none to the longest."""

STEP_NORM = 0.06
"""|a| dt of a Runge-Kutta step over a period, a the linearisation: right to 2e-7 of X's half-widths; over half a
period, to 1e-8."""
MOST_STEPS = 1000
"""For a plant that is stiff beside its period; what comes out is then less exact, or not finite."""


class Motion(Protocol):
    """The state up to one period ahead, in deviation coordinates."""

    def after(self, x: np.ndarray, u: np.ndarray, seconds: float) -> np.ndarray | None:
        """The state, (d,), `seconds` after x, (d,), under the input u, (m,).

        None where there is none: the motion leaves the domain of the equations, or is not finite.
        """
        ...


def motion_of(model: Model, certificate: Certificate) -> Motion:
    """By the plant's equations; with sets of a given W the linear motion.

    Raises:
        ModelError: the sets were computed from equations, and there are none.
    """
    if certificate.source_of_W == "given":
        return OfNumbers(model)
    return OfEquations(
        model, model.require_equations("the prediction over the delay, about which these sets are,")
    )


def over_any_delay(model: Model, W: np.ndarray) -> np.ndarray:
    """Half-widths, (d,), of a box that holds Phi w for every w of the box W, (d,), and every delay up to `LATEST`.

    Raises:
        CertificateError: nothing is known of the model's motion within a period.
    """
    within = require_prediction(model)
    seconds = np.linspace(0.0, LATEST * model.period, DELAYS).tolist()
    moved = [np.abs(discretise(within.a, within.b, one, within.units)[0]) @ W for one in seconds]
    return np.asarray(np.max(moved, axis=0))


def require_prediction(model: Model) -> Continuous:
    """The linear motion within a period. Raises `CertificateError`: nothing is known of it."""
    within = model.within
    if not isinstance(within, Continuous):
        raise CertificateError(
            f"{model.plant.name}: its A and B are in discrete time and have no motion between two samples, so that the "
            "state in which a command begins to act cannot be predicted. Certified sets need equations, A and B in "
            "continuous time, or such as come from them: no eigenvalue of A negative or zero"
        )
    return within


def require_certifiable(model: Model) -> None:
    """Raises `CertificateError`: the plant has a dead time, or rows beside its boxes.

    Nothing here bounds what h adds up to until a command acts, and a certificate knows X and U as boxes.
    """
    if model.plant.rows:
        raise CertificateError(
            f"{model.plant.name}: certified sets are made for X and U as boxes, and there are rows beside them "
            f"({', '.join(model.plant.rows)}): leave these out, or take another controller.tightening"
        )
    if model.plant.dead_time:
        raise CertificateError(
            f"{model.plant.name}: certified sets are about the state in which a command acts, and over a dead time of "
            f"{model.plant.dead_time:g} s that is not known well enough: take another controller.tightening"
        )


class OfNumbers:
    """The linear motion."""

    def __init__(self, model: Model):
        self._model = model

    def after(self, x: np.ndarray, u: np.ndarray, seconds: float) -> np.ndarray | None:
        found = self._model.ahead(x, u, seconds)
        return found if np.isfinite(found).all() else None


class OfEquations:
    """dx/dt = f(x, u), integrated."""

    def __init__(self, model: Model, plant: Plant):
        norm = float(np.abs(np.linalg.eigvals(plant.linearised()[1])).max()) * model.period
        steps = min(max(1, math.ceil(norm / STEP_NORM)), MOST_STEPS)
        x, u, seconds = ca.MX.sym("x", model.d), ca.MX.sym("u", model.m), ca.MX.sym("seconds")
        # The classical method of order 4: CasADi's own, where DOP853 would cost the start half a second for scipy.
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
