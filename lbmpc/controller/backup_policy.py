"""The backup policy: an affine policy that keeps the learned model in X while no commands reach the plant.

The plan of (e:LBMPC) satisfies the constraints of the *nominal* model. At each step only its first input is certified,
and each new sample corrects for h. Followed in open loop, the plan has no guarantee. A second problem is therefore
solved when time permits. It has the same cost, and the learned states replace the nominal ones:

    min over v      |z_N - x^r|_P^2 + sum_i |z_i - x^r|_Q^2 + |v_i - u^r|_R^2 + |v_i - v_{i-1}|_S^2
    subject to      z_{i+1} = A z_i + B v_i + h_hat(z_i, v_i),
                    v_i in U,   |v_i - v_{i-1}| <= rate T,   z_{i+1} in (1 - margin) X       i = 0 .. N-1

z_0 is the predicted state after the present command, and x^r is the target of that command's plan. The plant follows
the solution with feedback,

    u_i = v_i + K (x_i - z_i),

which needs only the plant's own sensors. The plant keeps u within its range and rate limits. K is stiffer than the
model's gain, so that errors of the plan do not accumulate. The policy is not certified, because h_hat is learned.

The margin leaves room for the error of h_hat. If the way to x^r runs along a bound, the margin can block it. A plan
that touches its margin and does not lead back, |z_N - x^r|_P >= 0.9 |z_0 - x^r|_P, is therefore solved again without
margin. If that costs less, it is solved a third time with the largest margin that should still lead back. Plans are
compared by the cost above plus the penalty for leaving X. The final state is no measure: of two plans that do not lead
back, one that leaves X at once may end as near as one that stays at its edge.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import casadi as ca
import numpy as np
from scipy.linalg import solve_discrete_are

from lbmpc.casadi_buffers import Bound
from lbmpc.model import Model
from lbmpc.oracles.base import remembered
from lbmpc.problem import Problem
from lbmpc.sets.constraint_sets import state_set
from lbmpc.sets.geometry.polytope import row_ranges
from lbmpc.solver.constraint_rows import Rows
from lbmpc.solver.least_distance import NO_ROWS
from lbmpc.solver.riccati import build_rows, build_sweep, with_input
from lbmpc.solver.subproblem import Subproblem

STEPS = 2
"""Gauss-Newton steps from the nominal plan, which is a good start. The best iterate is used."""
RAMP = 4
"""Steps over which the margin grows. A margin from the first step would require a jump of the input."""
NEARER = 0.9
"""A plan leads back if |z_N - x^r|_P is below this share of |z_0 - x^r|_P."""
CHEAPER = 0.9
"""A plan without margin is preferred if its cost is below this share of the cost with the full margin."""
TOUCHES = 1e-3
"""A plan touches a margin if it comes nearer than this share of the half-width."""
STIFFNESS = 25.0
"""Weight of the performance states in the LQR for K, relative to the input, each in units of its half-width."""


class Rollout(NamedTuple):
    """Inputs v (N, m), the learned states z_1 .. z_N (N, d), and the cost without penalties."""

    v: np.ndarray
    z: np.ndarray
    cost: float


@dataclass(frozen=True, eq=False)
class Policy:
    """The policy u_i = inputs[i] + gain x for N periods, in deviations: inputs (N, m), gain (m, d)."""

    inputs: np.ndarray
    gain: np.ndarray
    states: np.ndarray
    """The expected states z_0 .. z_{N-1}, (N, d)."""
    margin: float
    """Distance that the plan keeps from the bounds of X, as a share of the half-widths."""


class BackupPlanner:
    """Solves the backup problem with a fixed number of steps.

    Args:
        problem: the controller's problem, for its cost, oracle, horizon and U.
        margin: amount by which X shrinks, as a share of its half-widths, if a plan with it leads back.
        realise: turns a CasADi function into the function that is called, for example by compiling it.
    """

    def __init__(
        self,
        problem: Problem,
        margin: float,
        realise: Callable[[ca.Function], ca.Function] = lambda function: function,
    ):
        self.problem = problem
        model, oracle, n = problem.model, problem.oracle, problem.horizon
        self._margin = margin
        self._kept, self._plain = _rows(problem, margin), _rows(problem, 0.0)
        sweep = Bound(realise(build_sweep(model, oracle, n, "learned")))
        move = Bound(realise(build_rows(model, n, remembered(oracle), "learned")))
        self._subproblem = Subproblem(sweep, move)
        self._gain = tracking_gain(model)

    def policy(
        self,
        s: np.ndarray,
        theta: np.ndarray,
        plan: np.ndarray,
        xr: np.ndarray | None = None,
        ur: np.ndarray | None = None,
        previous: np.ndarray | None = None,
    ) -> Policy | None:
        """Return the policy that starts at the predicted state s.

        Args:
            s: predicted state after the present command, (D,), with its past if the oracle has a window.
            theta: the oracle's parameters.
            plan: the nominal plan from there on, (N, m).
            xr, ur: references as for `lbmpc.solver.gauss_newton.Solver.solve`.
            previous: the present command, (m,), as for `Solver.solve`.

        Returns:
            The policy; None if the numbers are not finite.
        """
        with np.errstate(all="ignore"):
            for rows in (self._kept, self._plain):
                rows.bound_first(None, previous)
            self._subproblem.load(with_input(self.problem.model, s, previous), theta, xr, ur)
            kept = self._best(self._kept, np.asarray(plan, dtype=float), STEPS)
            if kept is None:
                return None
            share, found = self._less(kept) if self._is_in_the_way(kept) else (1.0, kept)
        return self._with_feedback(s, found, share * self._margin)

    def _is_in_the_way(self, kept: Rollout) -> bool:
        return self._end(kept) >= NEARER and _touches(self._kept, kept)

    def _less(self, kept: Rollout) -> tuple[float, Rollout]:
        """Return the largest share of the margin that leads back, with its plan, or else the cheaper plan.

        The share is interpolated, taking the distance at the end of a plan as linear in the margin.
        """
        free = self._best(self._plain, kept.v, 1)
        if free is None or _price(self._plain, free) >= CHEAPER * _price(self._plain, kept):
            return 1.0, kept
        if (end := self._end(free)) >= NEARER:
            return 0.0, free
        share = (NEARER - end) / (self._end(kept) - end)
        between = self._best(_between(self._plain, self._kept, share), free.v, 1)
        return (0.0, free) if between is None else (share, between)

    def _end(self, rollout: Rollout) -> float:
        """|z_N|_P relative to |z_0|_P, both measured from the last target."""
        inputs, d = self._subproblem.sweep.inputs, self.problem.model.d
        start, target = inputs["x"][:d, 0], inputs["xr"][:, -1]
        return self._norm(rollout.z[-1] - target) / max(self._norm(start - target), np.finfo(float).tiny)

    def _norm(self, x: np.ndarray) -> float:
        """|x|_P of x (d,)."""
        return float(np.sqrt(x @ self.problem.model.P @ x))

    def _best(self, rows: Rows, v: np.ndarray, steps: int) -> Rollout | None:
        """Return the best iterate of `steps` steps from v, (N, m); None if its numbers are not finite."""
        best, least = None, np.inf
        subproblem, v = self._subproblem, rows.clip(v)
        for step in range(steps + 1):
            cost = subproblem.linearise(v)
            rollout = Rollout(v, subproblem.sweep.outputs["z"].T.copy(), cost)
            merit = _price(rows, rollout)
            if not np.isfinite(merit):
                break
            if merit < least:
                best, least = rollout, merit
            values = subproblem.values(rows)
            if step == steps or not np.isfinite(values).all():
                break
            target = subproblem.constrained(rows, values, NO_ROWS)
            if target is None:
                break
            v = target.v
        return best

    def _with_feedback(self, s: np.ndarray, rollout: Rollout, margin: float) -> Policy:
        gain, d = self._gain, self.problem.model.d
        states = np.vstack([s[:d], rollout.z[:-1]])
        return Policy(rollout.v - states @ gain.T, gain, states, margin)


def _rows(problem: Problem, margin: float) -> Rows:
    """Return the rows that keep the learned states inside (1 - margin) X."""
    plain = state_set(problem.model)
    inside = margin * row_ranges(plain.F, problem.model.plant.x_scale)
    shares = np.minimum(np.arange(1, problem.horizon + 1) / RAMP, 1.0)
    states = tuple(plain.minus(share * inside, share * inside) for share in shares)
    return Rows(replace(problem, states=states, soft=True, guard=None))


def _between(plain: Rows, kept: Rows, share: float) -> Rows:
    """Return the rows with this share of the margin, in (0, 1)."""
    rows = kept.fresh()
    both = (plain.lower, kept.lower), (plain.upper, kept.upper)
    rows.lower, rows.upper = ((1.0 - share) * without + share * with_it for without, with_it in both)
    return rows


def _price(rows: Rows, rollout: Rollout) -> float:
    """Return the cost plus the penalty for violating these rows."""
    return rollout.cost + rows.price(rows.values(rollout.v.T, rollout.z.T))


def _touches(rows: Rows, rollout: Rollout) -> bool:
    """Return whether any state comes close to its bounds."""
    values, near = rows.values(rollout.v.T, rollout.z.T), TOUCHES * rows.penalty.scale
    near_one = (values < rows.lower + near) | (values > rows.upper - near)
    return bool(near_one[rows.count_inputs :].any())


def tracking_gain(model: Model) -> np.ndarray:
    """Return K, (m, d), which holds the plant on a trajectory: an LQR with Bryson's weights in half-widths.

    If the Riccati equation has no solution for these weights, the result is the model's own K.
    """
    plant = model.plant
    weights = np.full(model.d, 1e-6)
    weights[list(plant.performance)] = STIFFNESS
    Q = np.diag(weights / plant.x_scale**2)
    R = np.diag(1.0 / plant.u_scale**2)
    try:
        P = solve_discrete_are(model.A, model.B, Q, R)
    except np.linalg.LinAlgError:
        return model.K
    return -np.linalg.solve(R + model.B.T @ P @ model.B, model.B.T @ P @ model.A)
