"""A quadrotor in a vertical plane, held by the thrusts of its two sides: six states, two inputs, unstable, fast.

    mass y''   = -efficiency (left + right) sin phi + drag (wind - y') |wind - y'|
    mass z''   =  efficiency (left + right) cos phi - drag z' |z'| - mass g
    inertia phi'' = efficiency arm (right - left)

| parameter | model | truth, in `quadrotor.toml` | source |
| --- | --- | --- | --- |
| mass, kg | 0.486 | the same | Tedrake, Underactuated Robotics, Quadrotor2D |
| inertia, kg m^2 | 0.00383 | the same | the same |
| arm, m | 0.25 | the same | the same |
| drag, N s^2/m^2 | 0.1 | the same | chosen: falls at 6.9 m/s at last; none in the linear model, since it is quadratic |
| wind, m/s | 0 | 2 | a light breeze |
| efficiency | 1 | 0.93 | chosen: a battery at the end of its charge |
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from lbmpc.plants import Plant, Rhs

GRAVITY = 9.81
PARAMETERS = {"mass": 0.486, "inertia": 0.00383, "arm": 0.25, "drag": 0.1, "wind": 0.0, "efficiency": 1.0}


def equations(mass: float, inertia: float, arm: float, drag: float, wind: float, efficiency: float) -> Rhs:
    """dx/dt of a quadrotor with these parameters."""

    def rhs(x: Any, u: Any) -> list[Any]:
        phi, vy, vz, omega = x[2], x[3], x[4], x[5]
        thrust, air = efficiency * (u[0] + u[1]), wind - vy
        return [
            vy,
            vz,
            omega,
            (-thrust * ca.sin(phi) + drag * air * ca.fabs(air)) / mass,
            (thrust * ca.cos(phi) - drag * vz * ca.fabs(vz)) / mass - GRAVITY,
            efficiency * arm * (u[1] - u[0]) / inertia,
        ]

    return rhs


HOVER = 0.5 * PARAMETERS["mass"] * GRAVITY

QUADROTOR = Plant(
    name="quadrotor",
    states=("y", "z", "phi", "vy", "vz", "omega"),
    inputs=("left", "right"),
    units={
        **{"y": "m", "z": "m", "phi": "rad", "vy": "m/s", "vz": "m/s", "omega": "rad/s"},
        **{"left": "N", "right": "N", "t": "s"},
    },
    rhs=equations(**PARAMETERS),
    parameters=PARAMETERS,
    equations=equations,
    x_e=np.zeros(6),
    u_e=np.array([HOVER, HOVER]),
    x_min=np.array([-2.0, -2.0, -0.6, -3.0, -3.0, -6.0]),
    x_max=np.array([2.0, 2.0, 0.6, 3.0, 3.0, 6.0]),
    u_min=np.array([0.0, 0.0]),
    u_max=np.array([2 * HOVER, 2 * HOVER]),
    # A tenth of g, a fifteenth of the largest torque, and the effect of both within a sample.
    W=np.array([0.02, 0.02, 0.2, 1.0, 1.0, 20.0]),
    x0=np.array([-1.5, -1.0, 0.0, 0.0, 0.0, 0.0]),
    safe_input=np.array([HOVER, HOVER]),
    performance=(0, 1),
    kernel=("phi", "vy", "vz", "left", "right"),
)
