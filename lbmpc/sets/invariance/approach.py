"""A trajectory of the true plant from a state into a set, with as much room to X's bounds as there is.

Only a proposal: nothing is claimed of it. `lbmpc.sets.invariance.regions` builds certified sets around it, or fails to.
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
"""|a| dt of one integration step at most."""
ENOUGH_ROOM = 0.04
"""Share of X's half-widths; a longer one is not looked for once one has it."""
LENGTHS = (10, 20, 40, 60, 90, 140)
DEPTH = 0.01
"""How deep inside the set it ends, as a share of X's half-widths."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """x (n + 1, d) and u (n, m) in deviation coordinates; `room` is to X's bounds, as a share of its half-widths."""

    x: np.ndarray
    u: np.ndarray
    room: float


def find_trajectory(model: Model, start: np.ndarray, goal: Body) -> Trajectory | None:
    """From `start`, (d,), into `goal`: the shortest of `LENGTHS` with enough room, else the roomiest, or None."""
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
    # Room first; among those of equal room the one that moves the inputs least.
    unit = U.upper - U.lower
    effort = sum(ca.sumsqr((u[:, k + 1] - u[:, k]) / unit) for k in range(steps - 1))
    opti.minimize(-100.0 * room + 0.1 * effort)
    opti.set_initial(x, np.linspace(start, goal.centre, steps + 1).T)
    opti.solver("ipopt", {"print_time": False}, {"print_level": 0, "sb": "yes", "max_iter": 200})
    try:
        found = opti.solve()
    except RuntimeError:  # infeasible, or not converged: there is none of this length
        return None
    xs = np.asarray(found.value(x)).reshape(model.d, -1).T
    return Trajectory(xs, np.asarray(found.value(u)).reshape(model.m, -1).T, float(found.value(room)))


def one_period(model: Model) -> ca.Function:
    """(x, u), deviations -> x after one period, (d,)."""
    plant = model.require_equations("a way into the sets")
    f = plant.function()
    x, u = ca.SX.sym("x", model.d), ca.SX.sym("u", model.m)
    steps = max(
        1, math.ceil(float(np.abs(np.linalg.eigvals(plant.linearised()[1])).max()) * model.period / STEP_NORM)
    )
    after = x + plant.x_e
    for _ in range(steps):
        after = dop853(f, after, u + plant.u_e, model.period / steps).after
    return ca.Function("one_period", [x, u], [after - plant.x_e])
