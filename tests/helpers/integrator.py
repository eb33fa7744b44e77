"""A third plant for tests: a mass pushed along a track with an end on one side only, and no limit to its speed."""

from __future__ import annotations

import casadi as ca

from lbmpc.plants.base import Plant


def _rhs(x, u):
    # Friction that the linear model does not know.
    return [x[1], u[0] - 0.3 * x[1] * ca.fabs(x[1])]


INTEGRATOR = Plant(
    name="integrator",
    states=["position", "speed"],
    inputs=["push"],
    units={"position": "m", "speed": "m/s", "push": "m/s^2", "t": "s"},
    rhs=_rhs,
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
