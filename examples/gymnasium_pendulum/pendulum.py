"""The true pendulum: Gymnasium's Pendulum-v1. Its state is set before every step, so that it remembers nothing."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np


class PendulumMotion:
    """Motion of x = (angle from upright in rad, rate in rad/s) under a torque in N m."""

    def __init__(self, **options: float):
        self.env: Any = gymnasium.make("Pendulum-v1", disable_env_checker=True, **options).unwrapped

    def step(self, x: np.ndarray, u: np.ndarray, dt: float) -> np.ndarray:
        """x(t + dt) from x(t) = x, (2,), under the constant u, (1,); Euler steps of at most 5 ms."""
        steps = int(np.ceil(dt / 0.005 - 1e-9))
        self.env.state, self.env.dt = np.array(x, dtype=float), dt / max(steps, 1)
        self.env.last_u = None
        for _ in range(steps):
            self.env.step(u)
        return self.env.state


PENDULUM = PendulumMotion(g=9.81)
