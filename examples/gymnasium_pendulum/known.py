"""What the controller knows of Pendulum-v1: matrices of a point mass on a rod of 1 m, about upright.

    angle'' = g / length angle + torque / (mass length^2)

The environment's pendulum is a uniform rod: gravity acts 1.5 times as much, by the sine, and the torque 3 times. It is
to be held at `LEAN`, where the matrices say that a torque of -1.47 N m is needed; -0.73 N m is.
"""

from __future__ import annotations

from lbmpc.plants import Known

GRAVITY, MASS, LENGTH, LEAN = 9.81, 1.0, 1.0, 0.15

PENDULUM = Known.from_matrices(
    A=[[0, 1], [GRAVITY / LENGTH, 0]],
    B=[[0], [1 / (MASS * LENGTH**2)]],
    name="pendulum",
    states=["angle", "rate"],
    inputs=["torque"],
    units={"angle": "rad", "rate": "rad/s", "torque": "N m"},
    x_e=[LEAN, 0],
    u_e=[-MASS * GRAVITY * LENGTH * LEAN],
    x_min=[-0.6, -2.0],
    x_max=[0.6, 2.0],
    u_min=[-2.0],
    u_max=[2.0],
    # What `tandem model check` finds of h, with the environment as the truth, and a little more.
    W=[0.2, 7.0],
    x0=[-0.2, 0.0],
    # No constant torque holds it upright.
    safe_gain=[[-12.0, -3.0]],
    performance=[0],
)
