"""X, U and the default W of a model, as sets in deviation coordinates."""

from __future__ import annotations

import numpy as np

from lbmpc.model import Model
from lbmpc.sets.geometry.polytope import EmptySetError, Polytope


def state_set(model: Model) -> Polytope:
    """X in deviation coordinates."""
    plant = model.plant
    return Polytope.box(plant.x_min - plant.x_e, plant.x_max - plant.x_e, plant.states)


def input_set(model: Model) -> Polytope:
    """U in deviation coordinates."""
    plant = model.plant
    return Polytope.box(plant.u_min - plant.u_e, plant.u_max - plant.u_e, plant.inputs)


def disturbance_set(model: Model, half_widths: np.ndarray | None = None) -> Polytope:
    """W as a box of half-widths (d,); by default the plant's own, which grow with the period as h does."""
    w = np.asarray(model.plant.W * model.period if half_widths is None else half_widths, dtype=float)
    if w.shape != (model.d,):
        raise EmptySetError(f"W has {w.size} half-widths, the plant has {model.d} states")
    return Polytope.box(-w, w, tuple(f"w_{name}" for name in model.plant.states))
