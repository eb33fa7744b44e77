"""Robust controllable sets along a trajectory into a control invariant set, with local bounds of h.

In a small cell of states and inputs h is nearly affine: h in slope_x x + slope_u u + W with W of second order in the
size of the cell. The sets are computed backwards along a trajectory from a state x_0 into the set C, with S_n = C,

    S_i = cell_i with X with {x : there is u in cell_i with (A + slope_x) x + (B + slope_u) u + W in S_{i+1}},

so from every state of S_i the plant can be steered into S_{i+1}, and finally into C, for every w in W. The family C,
S_{n-1}, ..., S_0 is robust control invariant. It is a union of polytopes, and contains x_0 if S_0 does.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from lbmpc.model import Model
from lbmpc.sets.constraint_sets import input_set, state_set
from lbmpc.sets.enclosures.disturbance import DisturbanceBound, Region, bound_affine
from lbmpc.sets.geometry.operations import Body, body, body_of
from lbmpc.sets.geometry.polytope import EmptySetError, Polytope, SetError
from lbmpc.sets.invariance.approach import Trajectory, find_trajectory
from lbmpc.sets.invariance.robust_control import UncertainSystem, predecessor

REMAINDERS = (1e-3, 5e-4)
"""Allowed sizes of W of a cell, as a share of X's half-widths, tried in turn."""
SPARE = 2e-5
"""Slack of each step beyond W, as a share of X's half-widths, for the rounding of the checker."""
LARGEST = 0.4
"""Largest half-width of a cell as a share of that of X and U."""


@dataclass(frozen=True, eq=False)
class ControllableSet:
    """S_i with the cell in which its bound of h is valid."""

    set: Body
    bound: DisturbanceBound


def controllable_sets(
    model: Model, start: np.ndarray, goal: Body, progress: Callable[[float], None] = lambda done: None
) -> list[ControllableSet]:
    """Return the sets S_{n-1}, ..., S_0, from the neighbour of `goal` back to the one that contains `start`, (d,).

    Raises:
        SetError: no such sets were found. The text says how far the construction got.
    """
    trajectory = find_trajectory(model, start, goal)
    if trajectory is None:
        raise SetError(
            "no trajectory of the true plant was found that leads from the given state into the invariant set inside X"
        )
    trouble = ""
    for remainder in REMAINDERS:
        try:
            return _along(model, trajectory, goal, remainder, progress)
        except EmptySetError as error:
            trouble = str(error)
    raise SetError(
        f"a trajectory into the invariant set exists, but no certified sets around it were found: {trouble}"
    )


def _along(
    model: Model, trajectory: Trajectory, goal: Body, remainder: float, progress: Callable[[float], None]
) -> list[ControllableSet]:
    size = cell_size(model, trajectory.x[0], trajectory.u[0], remainder)
    regions = [_region(model, x, u, size) for x, u in zip(trajectory.x[:-1], trajectory.u, strict=True)]
    bounds = bound_affine(model, regions)
    found: list[ControllableSet] = []
    target = goal
    for i in reversed(range(len(trajectory.u))):
        target = _one_step_into(
            model, target, bounds[i], f"the set {len(trajectory.u) - i} steps before the goal"
        )
        if not target.contains(trajectory.x[i]).all():
            raise EmptySetError(
                f"the set {len(trajectory.u) - i} steps before the goal misses the trajectory"
            )
        found.append(ControllableSet(target, bounds[i]))
        progress(len(found) / len(trajectory.u))
    return found


def _one_step_into(model: Model, target: Body, bound: DisturbanceBound, what: str) -> Body:
    """Return the states of the bound's cell, inside X, from which an input of the cell leads into the target."""
    region = bound.region
    X = body_of(state_set(model), "X", model.plant.x_scale)
    inputs = Polytope.box(region.u_lower, region.u_upper, model.plant.inputs)
    plant = UncertainSystem(model.A + bound.slope_x, model.B + bound.slope_u, bound, inputs)
    G, g = predecessor(target, plant, SPARE, X.scale)
    cell = Polytope.box(region.x_lower, region.x_upper, model.plant.states)
    G_cell, g_cell = cell.one_sided()
    return body(np.vstack([X.G, G_cell, G]), np.concatenate([X.g, g_cell, g]), what, X.scale).reduced()


def cell_size(model: Model, x: np.ndarray, u: np.ndarray, remainder: float) -> np.ndarray:
    """Return half-widths (d + m,) of a cell about (x, u) in which h is affine up to `remainder` of X's half-widths.

    The search starts with a large cell and repeatedly halves the side that reduces the remainder most.
    """
    half = _half_widths(model)
    size, d = LARGEST * half, model.d

    def remainders(sizes: Sequence[np.ndarray]) -> np.ndarray:
        bounds = bound_affine(model, [_region(model, x, u, s) for s in sizes])
        return np.array([np.ptp(b.vertices / half[:d], axis=0).max() / 2 for b in bounds])

    now = remainders([size])[0]
    while now > remainder:
        halved = [np.where(np.arange(len(size)) == i, 0.5, 1.0) * size for i in range(len(size))]
        found = remainders(halved)
        best = int(np.argmin(found))
        size, now = halved[best], found[best]
    return size


def _region(model: Model, x: np.ndarray, u: np.ndarray, size: np.ndarray) -> Region:
    """Return a cell about (x, u), intersected with X and U."""
    X, U, d = state_set(model), input_set(model), model.d
    return Region(
        np.maximum(x - size[:d], X.lower),
        np.minimum(x + size[:d], X.upper),
        np.maximum(u - size[d:], U.lower),
        np.minimum(u + size[d:], U.upper),
    )


def _half_widths(model: Model) -> np.ndarray:
    return np.concatenate([model.plant.x_scale, model.plant.u_scale])
