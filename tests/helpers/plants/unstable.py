"""One unstable state with any growth rate: dx/dt = rate x + rate u, linear, with X = U = [-1, 1].

| parameter | value | source |
| --- | --- | --- |
| rate, 1/s | any | it grows by exp(rate t); the horizon times the rate measures the difficulty |
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lbmpc.plants.equations import Plant, Rhs

SETTINGS = ["rate=20", "controller.horizon_seconds=3"]


def equations(rate: float) -> Rhs:
    """dx/dt with this rate."""

    def rhs(x: Any, u: Any) -> list[Any]:
        return [rate * x[0] + rate * u[0]]

    return rhs


def unstable(rate: float) -> Plant:
    """The plant with this rate, 1/s, from 0.3: its h is exactly 0."""
    return Plant(
        name=f"unstable_{rate:g}".replace(".", "_"),
        states=("x",),
        inputs=("u",),
        units={"x": "1", "u": "1", "t": "s"},
        rhs=equations(rate),
        parameters={"rate": rate},
        equations=equations,
        x_e=np.zeros(1),
        u_e=np.zeros(1),
        x_min=np.array([-1.0]),
        x_max=np.array([1.0]),
        u_min=np.array([-1.0]),
        u_max=np.array([1.0]),
        W=np.array([1e-3]),
        x0=np.array([0.3]),
        safe_input=np.zeros(1),
        performance=(0,),
        kernel=("x", "u"),
    )
