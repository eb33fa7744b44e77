"""An inverted pendulum with a torque at its pivot: two states, unstable, small enough to be quick.

    th'' = stiffness sin th + gain u

`PENDULUM` is slow. `inverted(length)` is a point mass on a rod of that length. Its torque is a share of the torque that
holds it horizontal: stiffness = gain = g / length.

| parameter | PENDULUM | inverted(length) | source |
| --- | --- | --- | --- |
| stiffness, 1/s^2 | 4 | 9.81 / length | the equations of a point mass |
| gain, 1/s^2 per unit of u | 1 | 9.81 / length | the same |
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np

from lbmpc.model import Model, build_model
from lbmpc.plants.equations import Plant, Rhs

GRAVITY = 9.81
PARAMETERS = {"stiffness": 4.0, "gain": 1.0}


def equations(stiffness: float, gain: float) -> Rhs:
    """dx/dt of a pendulum with these parameters."""

    def rhs(x: Any, u: Any) -> list[Any]:
        return [x[1], stiffness * ca.sin(x[0]) + gain * u[0]]

    return rhs


PENDULUM = Plant(
    name="pendulum",
    states=("angle", "rate"),
    inputs=("torque",),
    units={"angle": "rad", "rate": "rad/s", "torque": "1/s^2", "t": "s"},
    rhs=equations(**PARAMETERS),
    parameters=PARAMETERS,
    equations=equations,
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


def inverted(length: float) -> Plant:
    """Return a pendulum of this length, metres, from 0.3 rad; u = 1 holds it horizontal and is the largest input."""
    fastest = np.sqrt(GRAVITY / length)
    parameters = {"stiffness": GRAVITY / length, "gain": GRAVITY / length}
    return replace(
        PENDULUM,
        name=f"pendulum_{length:g}m".replace(".", "_"),
        units={"angle": "rad", "rate": "rad/s", "torque": "1", "t": "s"},
        rhs=equations(**parameters),
        parameters=parameters,
        x_min=np.array([-1.0, -fastest]),
        x_max=np.array([1.0, fastest]),
        u_min=np.array([-1.0]),
        u_max=np.array([1.0]),
        W=np.array([1e-3, 1e-3 * fastest]),
        x0=np.array([0.3, 0.0]),
    )


def pendulum(period: float = 0.1) -> Model:
    """The model of `PENDULUM`; seconds."""
    return build_model(PENDULUM, period)


def two_inputs() -> Model:
    """A pendulum with a second, weak input."""
    both = replace(
        PENDULUM,
        name="two_inputs",
        inputs=("left", "right"),
        rhs=lambda x, u: [x[1] + 0.3 * u[1], 4.0 * ca.sin(x[0]) + u[0]],
        parameters={},
        equations=None,
        u_e=np.zeros(2),
        u_min=np.array([-3.0, -1.0]),
        u_max=np.array([3.0, 1.0]),
        safe_input=np.zeros(2),
    )
    return build_model(both, 0.1)
