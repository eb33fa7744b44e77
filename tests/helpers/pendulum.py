"""A second plant for tests: an inverted pendulum with a torque, two states, unstable, small enough to be quick."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np

from lbmpc.model import Model, build_model
from lbmpc.plants.base import Plant


def _rhs(x, u):
    return [x[1], 4.0 * ca.sin(x[0]) + u[0]]


PENDULUM = Plant(
    name="pendulum",
    states=("angle", "rate"),
    inputs=("torque",),
    units={"angle": "rad", "rate": "rad/s", "torque": "1/s^2", "t": "s"},
    rhs=_rhs,
    x_e=np.zeros(2),
    u_e=np.zeros(1),
    x_min=np.array([-1.0, -2.0]),
    x_max=np.array([1.0, 2.0]),
    u_min=np.array([-3.0]),
    u_max=np.array([3.0]),
    W=np.array([0.01, 0.1]),
    x0=np.array([0.5, 0.0]),
    safe_input=np.zeros(1),
    performance=(0,),
    kernel=("angle", "torque"),
)


def pendulum(period: float = 0.1) -> Model:
    return build_model(PENDULUM, period)


def two_inputs() -> Model:
    both = replace(
        PENDULUM,
        name="two_inputs",
        inputs=("left", "right"),
        rhs=lambda x, u: [x[1] + 0.3 * u[1], 4.0 * ca.sin(x[0]) + u[0]],
        u_e=np.zeros(2),
        u_min=np.array([-3.0, -1.0]),
        u_max=np.array([3.0, 1.0]),
        safe_input=np.zeros(2),
    )
    return build_model(both, 0.1)
