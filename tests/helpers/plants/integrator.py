"""A mass that is pushed along a track with a bound on one side only, without a bound on its speed.

| parameter | value | source |
| --- | --- | --- |
| friction, 1/m | 0.3 | chosen: the linear model does not contain it, because it is quadratic in the speed |
"""

from __future__ import annotations

from typing import Any

import casadi as ca

from lbmpc.plants.equations import Plant, Rhs

PARAMETERS = {"friction": 0.3}


def equations(friction: float) -> Rhs:
    """dx/dt of a mass with this friction."""

    def rhs(x: Any, u: Any) -> list[Any]:
        return [x[1], u[0] - friction * x[1] * ca.fabs(x[1])]

    return rhs


INTEGRATOR = Plant(
    name="integrator",
    states=["position", "speed"],
    inputs=["push"],
    units={"position": "m", "speed": "m/s", "push": "m/s^2", "t": "s"},
    rhs=equations(**PARAMETERS),
    parameters=PARAMETERS,
    equations=equations,
    x_e=[0, 0],
    u_e=[0],
    x_min=[-1.0, -float("inf")],
    x_max=[1.0, float("inf")],
    u_min=[-2.0],
    u_max=[2.0],
    W=[0.02, 0.2],
    x0=[-0.9, 0.0],
    safe_input=[0.0],
    performance=[0, 1],
    kernel=["speed", "push"],
    scale={"speed": 2.0},
)
