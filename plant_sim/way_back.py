"""Whether a plant under an input by hand can still be brought back inside X, one period later.

A gateway knows the linear model and no h. So of the state after one more period under u it asks whether the feedback of
the model, clipped to U, keeps what the model predicts in X from there on,

    z_1 = A x + B u,    v_i = clip(K z_i, U),    z_{i+1} = A z_i + B v_i,
    z_i in (1 - margin_i) X - (A + BK)^{i-1} W                                            i = 1 .. N,

where W is what the model may miss in that one period, and margin_i grows to the margin of the backup policy. Who takes
over then, a controller that sees the state and has learned h, can do no worse by this model than K does. What h does on
the way back itself is in the margin alone, and asked anew at the next sample.
"""

from __future__ import annotations

import numpy as np

from lbmpc.model import Model, ModelError, build_model
from lbmpc.plants import Known, Plant
from node_runtime.config.sections import Config
from node_runtime.config.strict import ConfigError

RAMP = 4
"""Steps over which the margin grows, as that of `lbmpc.controller.backup_policy` does."""


class WayBack:
    """For one plant; all numbers in plant units.

    Args:
        model: of the plant, at its period.
        margin: by how much X shrinks, as a share of its half-widths.
        steps: N, how far it is followed.
    """

    def __init__(self, model: Model, margin: float, steps: int):
        self._model = model
        plant = model.plant
        self._w = plant.W * model.period
        self._absolute = np.abs(model.A)
        shares = np.minimum(np.arange(1, steps + 1) / RAMP, 1.0)[:, None]
        inside = margin * shares * plant.x_scale
        self._low, self._high = plant.x_min - plant.x_e + inside, plant.x_max - plant.x_e - inside
        self._u_low, self._u_high = plant.u_min - plant.u_e, plant.u_max - plant.u_e
        powers = [np.eye(model.d)]
        for _ in range(steps - 1):
            powers.append(model.closed_loop @ powers[-1])
        self._spread = np.abs(np.array(powers))
        self._after: tuple[np.ndarray, np.ndarray] | None = None

    def begin(self) -> None:
        """Forget what was predicted: what acts is somebody else's."""
        self._after = None

    def lost(self, x: np.ndarray | None, u: np.ndarray) -> str:
        """What keeps the input u, (m,), from acting for one more period, for a person; empty where nothing does.

        x: the state now, (d,); None: not measured, and what the last call predicted stands for it, with what the model
        may have missed since.
        """
        plant, model = self._model.plant, self._model
        if x is not None:
            z, spread = x - plant.x_e, np.zeros(model.d)
        elif self._after is not None:
            z, spread = self._after
        else:
            return "the state is not measured"
        with np.errstate(over="ignore", invalid="ignore"):
            z, spread = model.step(z, u - plant.u_e), self._absolute @ spread + self._w
            self._after = z, spread
            beside = self._spread @ spread
            low, high = self._low + beside, self._high - beside
            for i in range(len(low)):
                # Also where it is no number.
                inside = (z >= low[i]) & (z <= high[i])
                if not inside.all():
                    state = plant.states[int(np.argmin(inside))]
                    return f"{state} would leave X within {(i + 1) * model.period:.3g} s"
                v = np.minimum(np.maximum(model.K.dot(z), self._u_low), self._u_high)
                z = model.step(z, v)
        return ""


def way_back_of(config: Config, plant: Known | Plant) -> WayBack:
    """That of the configured controller's model. Raises `ConfigError`: there is no such model."""
    settings = config.controller
    Q, R = (None if weights is None else np.array(weights) for weights in (settings.Q, settings.R))
    try:
        model = build_model(plant, config.period, Q, R, settings.terminal)
    except ModelError as error:
        raise ConfigError(f"controller: {error}") from error
    return WayBack(model, settings.backup.margin, settings.horizon)
