"""The same plant in other units: states, inputs and all values in their units times a factor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lbmpc.plants.equations import Plant


def rescaled(plant: Plant, x: Sequence[float], u: Sequence[float]) -> Plant:
    """`plant` with its states times x, (d,), and its inputs times u, (m,)."""
    x, u = np.asarray(x, dtype=float), np.asarray(u, dtype=float)
    factors = dict(zip((*plant.states, *plant.inputs), (*x.tolist(), *u.tolist()), strict=True))

    def rhs(states, inputs):
        own = [states[i] / x[i] for i in range(plant.d)], [inputs[j] / u[j] for j in range(plant.m)]
        return [slope * factor for slope, factor in zip(plant.rhs(*own), x.tolist(), strict=True)]

    vectors = {name: getattr(plant, name) * x for name in ("x_e", "x_min", "x_max", "W", "x0")}
    vectors |= {name: getattr(plant, name) * u for name in ("u_e", "u_min", "u_max", "safe_input")}
    gain = plant.safe_gain
    return replace(
        plant,
        rhs=rhs,
        **vectors,
        safe_gain=None if gain is None else gain * u[:, None] / x,
        scale={name: width * factors[name] for name, width in plant.scale.items()},
        parameters={},
        equations=None,
    )
