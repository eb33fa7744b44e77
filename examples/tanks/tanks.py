"""Two tanks in cascade, levels in cm, slow and stable: the pump fills the upper one, which empties into the lower one.

    area_1 dh1/dt = q - (outlet_1 + leak) sqrt(2 g h1)
    area_2 dh2/dt = outlet_1 sqrt(2 g h1) - outlet_2 sqrt(2 g h2)

What leaks from the upper tank is lost.

| parameter | model | truth, in `tanks.toml` | source |
| --- | --- | --- | --- |
| area_1, cm^2 | 28 | the same | Johansson (2000), The quadruple-tank process, A1 |
| area_2, cm^2 | 32 | the same | the same, A2 |
| outlet_1, cm^2 | 0.071 | 0.08875, 25 % more | the same, a1 |
| outlet_2, cm^2 | 0.057 | 0.07125, 25 % more | the same, a2 |
| leak, cm^2 | 0 | 0.01 | chosen: a seventh of outlet_1 |
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from lbmpc.plants import Domain, Plant, Rhs

GRAVITY = 981.0
PARAMETERS = {"area_1": 28.0, "area_2": 32.0, "outlet_1": 0.071, "outlet_2": 0.057, "leak": 0.0}


def equations(area_1: float, area_2: float, outlet_1: float, outlet_2: float, leak: float) -> Rhs:
    """dx/dt of tanks with these parameters."""

    def rhs(x: Any, u: Any) -> list[Any]:
        first, second = ca.sqrt(2 * GRAVITY * x[0]), ca.sqrt(2 * GRAVITY * x[1])
        return [
            (u[0] - (outlet_1 + leak) * first) / area_1,
            (outlet_1 * first - outlet_2 * second) / area_2,
        ]

    return rhs


LEVEL = 10.0
Q_E = PARAMETERS["outlet_2"] * np.sqrt(2 * GRAVITY * LEVEL)

TANKS = Plant(
    name="tanks",
    states=("h1", "h2"),
    inputs=("q",),
    units={"h1": "cm", "h2": "cm", "q": "cm^3/s", "t": "s"},
    rhs=equations(**PARAMETERS),
    names={"h1": "upper level h1", "h2": "lower level h2", "q": "inflow q"},
    parameters=PARAMETERS,
    equations=equations,
    x_e=np.array([LEVEL * (PARAMETERS["outlet_2"] / PARAMETERS["outlet_1"]) ** 2, LEVEL]),
    u_e=np.array([Q_E]),
    x_min=np.array([1.0, 1.0]),
    x_max=np.array([20.0, 20.0]),
    u_min=np.array([0.0]),
    u_max=np.array([20.0]),
    # A third of the inflow at x_e, cm/s.
    W=np.array([0.1, 0.08]),
    x0=np.array([2.0, 4.0]),
    safe_input=np.array([Q_E]),
    performance=(1,),
    kernel=("h1", "h2", "q"),
    positive=(Domain(0, "upper level h1", "cm"), Domain(1, "lower level h2", "cm")),
)
