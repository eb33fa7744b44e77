"""The jet-engine compressor of Moore and Greitzer with a second-order throttle actuator.

    dz/dt = -y + z_c + 1 + 3/2 z - z^3 / 2        mass flow z
    dy/dt = (z + 1 - r sqrt(y)) / beta^2          pressure rise y
    d2r/dt2 = omega_n^2 (u - r) - 2 zeta omega_n dr/dt

In the paper, (e:Moore-Greitzer-model) has sqrt(z) in the pressure equation. The throttle acts on pressure, and only
sqrt(y) makes (0.5, 1.6875, 1.1547, 0) an equilibrium.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from lbmpc.plants.equations import Domain, Plant, Rhs

ZETA, OMEGA_N = 1 / np.sqrt(2.0), 10 * np.sqrt(10.0)
PARAMETERS = {"beta": 1.0, "z_c": 0.0, "slope": 1.5}
"""beta, z_c, and the slope 3/2 of the compressor characteristic."""


def equations(beta: float, z_c: float, slope: float) -> Rhs:
    """Return dx/dt of a compressor with these parameters."""

    def rhs(x: Any, u: Any) -> list[Any]:
        z, y, r, rdot = x[0], x[1], x[2], x[3]
        return [
            -y + z_c + 1 + slope * z - 0.5 * z**3,
            (z + 1 - r * ca.sqrt(y)) / beta**2,
            rdot,
            OMEGA_N**2 * (u[0] - r) - 2 * ZETA * OMEGA_N * rdot,
        ]

    return rhs


# The exact equilibrium throttle at z = 0.5, y = 1.6875. The paper has 1.1547, rounded to four digits.
R_E = 1.5 / np.sqrt(1.6875)

# Aswani et al. (2013) place the poles of A + BK at T = 0.01 s; these are their continuous-time counterparts.
POLES = tuple(complex(np.log(p) / 0.01) for p in (0.75, 0.78, 0.98, 0.99))

MOORE_GREITZER = Plant(
    name="moore_greitzer",
    states=("z", "y", "r", "rdot"),
    inputs=("u",),
    units={"z": "1", "y": "1", "r": "1", "rdot": "1/s", "u": "1", "t": "s"},
    rhs=equations(**PARAMETERS),
    names={"z": "mass flow z", "y": "pressure rise y", "r": "throttle opening r", "u": "throttle command u"},
    parameters=PARAMETERS,
    equations=equations,
    x_e=np.array([0.5, 1.6875, R_E, 0.0]),
    u_e=np.array([R_E]),
    x_min=np.array([0.0, 1.1875, 0.1547, -20.0]),
    x_max=np.array([1.0, 2.1875, 2.1547, 20.0]),
    u_min=np.array([0.1547]),
    u_max=np.array([2.1547]),
    # At T = 0.05 s: (0.003, 0.0005, 1e-5, 1.1e-4), the largest margin with which all controllers keep X from x0.
    W=np.array([0.06, 0.01, 2e-4, 2.2e-3]),
    x0=np.array([0.15, 1.2875, 1.1547, 0.0]),
    safe_input=np.array([R_E]),
    # x_e is unstable under a constant throttle. The gain uses flow and pressure only; it is stable from 10 to 1000 Hz.
    safe_gain=np.array([[-2.8, 1.9, 0.0, 0.0]]),
    performance=(0, 1),
    kernel=("z", "y", "u"),
    poles=POLES,
    positive=(Domain(1, "pressure y", ""),),
)
