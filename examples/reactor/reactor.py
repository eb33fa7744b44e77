"""An exothermic stirred-tank reactor at its unstable operating point.

    dc/dt = q (c_in - c) - r,    dT/dt = q (T_in - T) + a r + b (T_c - T),    r = k_0 exp(-E / T) c

c is the concentration, T the temperature, T_c that of the coolant. The rates are those of the widely used benchmark
reactor (Seborg, Edgar, Mellichamp, Process Dynamics and Control), in seconds and moles.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from lbmpc.plants import Plant, Rhs

FLOW, INFLOW, FEED = 1 / 60, 1000.0, 350.0
"""q in 1/s, c_in in mol/m3, T_in in K."""
ACTIVATION, HEAT, COOLING = 8750.0, 5e4 / 2.39e5, 5e4 / 6.0 / 2.39e5
"""E in K, a in K m3/mol, b in 1/s."""
K_0 = 7.2e10 / 60


def equations(k_0: float) -> Rhs:
    """dx/dt of a reactor whose reaction has this rate constant, 1/s."""

    def rhs(x: Any, u: Any) -> list[Any]:
        c, T = x[0], x[1]
        rate = k_0 * ca.exp(-ACTIVATION / T) * c
        return [FLOW * (INFLOW - c) - rate, FLOW * (FEED - T) + HEAT * rate + COOLING * (u[0] - T)]

    return rhs


# Near (500, 350), where with a constant coolant the reaction stops or runs away.
REACTOR = Plant(
    name="reactor",
    states=("c", "T"),
    inputs=("T_c",),
    units={"c": "mol/m^3", "T": "K", "T_c": "K", "t": "s"},
    names={"c": "concentration c", "T": "temperature T", "T_c": "coolant T_c"},
    rhs=equations(K_0),
    equations=equations,
    parameters={"k_0": K_0},
    x_e=np.array([500.0, 350.0]),
    u_e=np.array([300.0]),
    x_min=np.array([100.0, 320.0]),
    x_max=np.array([900.0, 380.0]),
    u_min=np.array([270.0]),
    u_max=np.array([330.0]),
    W=np.array([1.0, 0.2]),
    x0=np.array([560.0, 346.0]),
    safe_input=np.array([300.0]),
    performance=(0,),
    kernel=("c", "T", "T_c"),
).resting_near()
