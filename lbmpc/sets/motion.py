"""Where the plant is a part of a period later, by its own equations: dx/dt = f(x, u), u constant.

The sets are about the state in which a command begins to act. What predicts that state decides what is certified, so
it is no oracle's guess: the equations are those that the sets were computed for.
"""

from __future__ import annotations

import math

import casadi as ca
import numpy as np

from lbmpc.casadi_buffers import Bound
from lbmpc.model import Model

STEP_NORM = 0.06
"""|a| dt of a Runge-Kutta step over a period, a the linearisation: right to 2e-7 of X's half-widths; over half a
period, to 1e-8."""
MOST_STEPS = 1000
"""For a plant that is stiff beside its period; what comes out is then less exact, or not finite."""


class Motion:
    """The state up to one period ahead, in deviation coordinates."""

    def __init__(self, model: Model):
        plant = model.require_equations("the prediction over the delay")
        norm = float(np.abs(np.linalg.eigvals(model.a)).max()) * model.period
        steps = min(max(1, math.ceil(norm / STEP_NORM)), MOST_STEPS)
        x, u, seconds = ca.MX.sym("x", model.d), ca.MX.sym("u", model.m), ca.MX.sym("seconds")
        # The classical method of order 4: CasADi's own, where DOP853 would cost the start half a second for scipy.
        step = ca.simpleRK(plant.function(), steps, 4)
        after = step(x + plant.x_e, u + plant.u_e, seconds) - plant.x_e
        self._after = Bound(
            ca.Function("motion", [x, u, seconds], [after], ["x", "u", "seconds"], ["after"]).expand()
        )

    def after(self, x: np.ndarray, u: np.ndarray, seconds: float) -> np.ndarray | None:
        """The state, (d,), `seconds` after x, (d,), under the input u, (m,).

        None where the equations give none: the motion leaves their domain, or is not finite.
        """
        function = self._after
        function.inputs["x"][:, 0], function.inputs["u"][:, 0] = x, u
        function.inputs["seconds"][0, 0] = seconds
        function()
        found = function.outputs["after"][:, 0].copy()
        return found if np.isfinite(found).all() else None
