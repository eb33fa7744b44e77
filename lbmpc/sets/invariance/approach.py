"""A trajectory of the true plant from a state into a set, with the largest possible distance to the bounds of X.

The trajectory is only a proposal. `lbmpc.sets.invariance.regions` tries to build certified sets around it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import casadi as ca
import numpy as np

from lbmpc.model import Model
from lbmpc.plants.truth import dop853
from lbmpc.sets.constraint_sets import input_set, state_set
from lbmpc.sets.geometry.operations import Body

STEP_NORM = 0.4
"""Upper limit of |a| dt per integration step."""
ENOUGH_ROOM = 0.04
"""Share of X's half-widths. Longer trajectories are not tried once one has this distance."""
LENGTHS = (10, 20, 40, 60, 90, 140)
DEPTH = 0.01
"""Distance of the final state from the boundary of the set, as a share of X's half-widths."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """x (n + 1, d) and u (n, m) in deviations; `room` is the distance to X's bounds as a share of its half-widths."""

    x: np.ndarray
    u: np.ndarray
    room: float


def find_trajectory(model: Model, start: np.ndarray, goal: Body) -> Trajectory | None:
    """Return the shortest trajectory from `start`, (d,), into `goal` with enough room, else the best one, or None."""
    best = None
    for steps in LENGTHS:
        found = _of_length(model, start, goal, steps)
        if found is not None and (best is None or found.room > best.room):
            best = found
        if best is not None and best.room >= ENOUGH_ROOM:
            break
    return best


def _of_length(model: Model, start: np.ndarray, goal: Body, steps: int) -> Trajectory | None:
    plant = model.plant
    half = plant.x_scale
    X, U = state_set(model), input_set(model)
    spare = 0.02 * (U.upper - U.lower)
    move = one_period(model)
    opti = ca.Opti()
    x, u, room = opti.variable(model.d, steps + 1), opti.variable(model.m, steps), opti.variable()
    opti.subject_to(x[:, 0] == start)
    for k in range(steps):
        opti.subject_to(x[:, k + 1] == move(x[:, k], u[:, k]))
        opti.subject_to(opti.bounded(U.lower + spare, u[:, k], U.upper - spare))
        opti.subject_to(x[:, k + 1] >= X.lower + room * half)
        opti.subject_to(x[:, k + 1] <= X.upper - room * half)
    opti.subject_to(opti.bounded(0.0, room, 2 * ENOUGH_ROOM))
    lengths = np.linalg.norm(goal.G * half, axis=1)
    opti.subject_to(ca.DM(goal.G) @ x[:, steps] <= goal.g - DEPTH * lengths)
    # Maximise the room; among trajectories of equal room minimise the motion of the inputs.
    unit = U.upper - U.lower
    effort = sum(ca.sumsqr((u[:, k + 1] - u[:, k]) / unit) for k in range(steps - 1))
    opti.minimize(-100.0 * room + 0.1 * effort)
    opti.set_initial(x, np.linspace(start, goal.centre, steps + 1).T)
    opti.solver("ipopt", {"print_time": False}, {"print_level": 0, "sb": "yes", "max_iter": 200})
    try:
        found = opti.solve()
    except RuntimeError:  # infeasible or not converged: no trajectory of this length
        return None
    xs = np.asarray(found.value(x)).reshape(model.d, -1).T
    return Trajectory(xs, np.asarray(found.value(u)).reshape(model.m, -1).T, float(found.value(room)))


def one_period(model: Model) -> ca.Function:
    """Build (x, u), in deviations, -> x after one period, (d,)."""
    plant = model.require_equations("a trajectory into the sets")
    f = plant.function()
    x, u = ca.SX.sym("x", model.d), ca.SX.sym("u", model.m)
    steps = max(
        1, math.ceil(float(np.abs(np.linalg.eigvals(plant.linearised()[1])).max()) * model.period / STEP_NORM)
    )
    after = x + plant.x_e
    for _ in range(steps):
        after = dop853(f, after, u + plant.u_e, model.period / steps).after
    return ca.Function("one_period", [x, u], [after - plant.x_e])
