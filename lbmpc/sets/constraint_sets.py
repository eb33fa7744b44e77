"""X, U and the default W of a model, as sets in deviation coordinates."""

from __future__ import annotations

import numpy as np

from lbmpc.model import Model
from lbmpc.plants.rows import LinearRows
from lbmpc.sets.geometry.polytope import EmptySetError, Polytope


def state_set(model: Model) -> Polytope:
    """Return X in deviation coordinates: its box, then its rows."""
    plant = model.plant
    box = Polytope.box(plant.x_min - plant.x_e, plant.x_max - plant.x_e, plant.states)
    return _beside(box, plant.state_rows.about(plant.x_e))


def input_set(model: Model) -> Polytope:
    """Return U in deviation coordinates: its box, then its rows."""
    plant = model.plant
    box = Polytope.box(plant.u_min - plant.u_e, plant.u_max - plant.u_e, plant.inputs)
    return _beside(box, plant.input_rows.about(plant.u_e))


def disturbance_set(model: Model, half_widths: np.ndarray | None = None) -> Polytope:
    """Return W as a box of half-widths (d,), by default the plant's W times the period."""
    w = np.asarray(model.plant.W * model.period if half_widths is None else half_widths, dtype=float)
    if w.shape != (model.d,):
        raise EmptySetError(f"W has {w.size} half-widths, the plant has {model.d} states")
    return Polytope.box(-w, w, tuple(f"w_{name}" for name in model.plant.states))


def _beside(box: Polytope, rows: LinearRows) -> Polytope:
    """Return the intersection of box and rows, with the rows of the box first."""
    if not rows.names:
        return box
    return Polytope(
        np.vstack([box.F, rows.F]),
        np.concatenate([box.lower, rows.lower]),
        np.concatenate([box.upper, rows.upper]),
        box.names + rows.names,
    )
