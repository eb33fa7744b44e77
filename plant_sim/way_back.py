"""Checks whether a plant under a manual input can still be brought back inside X one period later.

A gateway knows the linear model and not h. For the state after one more period under u it checks that the model's
feedback, clipped to U and to the rate limits, keeps the predicted states in X,

    z_1 = A x + B u,    v_i = clip(K z_i, U and the rate after v_{i-1}),    z_{i+1} = A z_i + B v_i,
    z_i in (1 - margin_i) X - (A + BK)^{i-1} W                                            i = 1 .. N.

W bounds the model error in that one period, and margin_i grows to the margin of the backup policy. A controller that
takes over then, with the state and a learned h, can do at least as well by this model as K. The effect of h on the way
back is covered by the margin alone, and the check is repeated at the next sample.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lbmpc.model import Model, ModelError, build_model
from lbmpc.plants import Known, Plant
from lbmpc.sets.constraint_sets import state_set
from node_runtime.config.sections import Config
from node_runtime.config.strict import ConfigError

RAMP = 4
"""Steps over which the margin grows, as in `lbmpc.controller.backup_policy`."""


class Ahead(NamedTuple):
    """Predicted state in deviations, and the largest error of each state, (d,) each."""

    z: np.ndarray
    spread: np.ndarray


class WayBack:
    """The check for one plant. It has no state.

    Args:
        model: the plant's model at its period.
        margin: amount by which X shrinks, as a share of its half-widths.
        steps: N, the number of predicted periods.
    """

    def __init__(self, model: Model, margin: float, steps: int):
        self._model = model
        plant = model.plant
        self._w = plant.W * model.period
        self._absolute = np.abs(model.A)
        shares = np.minimum(np.arange(1, steps + 1) / RAMP, 1.0)[:, None]
        X, inside = state_set(model), margin * shares
        # The box first, then the other rows.
        self._rows, self._names = plant.state_rows.F, X.names
        widths = np.concatenate([plant.x_scale, plant.state_rows.ranges])
        self._low, self._high = X.lower + inside * widths, X.upper - inside * widths
        powers = [np.eye(model.d)]
        for _ in range(steps - 1):
            powers.append(model.closed_loop @ powers[-1])
        self._spread = np.abs(np.array([self._bounded(power) for power in powers]))

    def of(self, x: np.ndarray) -> Ahead:
        """Return the prediction at a measured state, (d,)."""
        return Ahead(x - self._model.plant.x_e, np.zeros(self._model.d))

    def after(self, now: Ahead, u: np.ndarray) -> Ahead:
        """Return the prediction one period later under the input u, (m,)."""
        model = self._model
        return Ahead(model.step(now.z, u - model.plant.u_e), self._absolute @ now.spread + self._w)

    def reached(self, acting: np.ndarray, wanted: np.ndarray) -> np.ndarray:
        """Return the input, (m,), of the next period if `wanted` is requested, within the rate limits."""
        return self._model.plant.reachable(wanted, acting, self._model.period)

    def lost(self, there: Ahead, u: np.ndarray) -> str:
        """Return what leaves X on the way back from `there`, after the input u, (m,); "" if nothing does."""
        model, z, v = self._model, there.z, u - self._model.plant.u_e
        with np.errstate(over="ignore", invalid="ignore"):
            beside = self._spread @ there.spread
            low, high = self._low + beside, self._high - beside
            for i in range(len(low)):
                # NaN counts as outside.
                values = self._bounded(z)
                inside = (values >= low[i]) & (values <= high[i])
                if not inside.all():
                    name = self._names[int(np.argmin(inside))]
                    return f"{name} would leave X within {(i + 1) * model.period:.3g} s"
                v = self.reached(v, model.plant.within_about(model.K.dot(z)))
                z = model.step(z, v)
        return ""

    def _bounded(self, z: np.ndarray) -> np.ndarray:
        """Return the values that X bounds: z, (d, ...), followed by the values of the rows."""
        return np.concatenate([z, self._rows @ z]) if len(self._rows) else z


def way_back_of(config: Config, plant: Known | Plant) -> WayBack:
    """Return the check for the configured controller's model. Raises `ConfigError` if there is no such model."""
    settings = config.controller
    Q, R = (None if weights is None else np.array(weights) for weights in (settings.Q, settings.R))
    try:
        model = build_model(plant, config.period, Q, R, settings.terminal)
    except ModelError as error:
        raise ConfigError(f"controller: {error}") from error
    return WayBack(model, settings.backup.margin, settings.horizon)
