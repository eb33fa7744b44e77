"""The true crane: MuJoCo moves it. Tandem only calls `step`."""

from __future__ import annotations

import math
from pathlib import Path

import mujoco
import numpy as np


class MujocoMotion:
    """The motion of a MuJoCo model with state x = (qpos, qvel) and controls u; no other quantity moves it."""

    def __init__(self, model: mujoco.MjModel):
        self.model, self.data, self.timestep = model, mujoco.MjData(model), model.opt.timestep

    def step(self, x: np.ndarray, u: np.ndarray, dt: float) -> np.ndarray:
        """x(t + dt) from x(t) = x, (d,), under the constant u, (m,); in equal steps of the model's timestep at most."""
        steps = math.ceil(dt / self.timestep - 1e-9)
        if steps < 1:
            return np.array(x, dtype=float)
        self.model.opt.timestep = dt / steps
        # This also resets the constraint solver's warm start, so that equal inputs give equal results.
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:], self.data.qvel[:] = np.split(np.asarray(x, dtype=float), [self.model.nq])
        self.data.ctrl[:] = u
        mujoco.mj_step(self.model, self.data, nstep=steps)
        return np.concatenate([self.data.qpos, self.data.qvel])


CRANE = MujocoMotion(mujoco.MjModel.from_xml_path(str(Path(__file__).with_name("crane.xml"))))
