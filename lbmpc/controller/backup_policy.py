"""What the plant follows when its controller falls silent: an affine policy that keeps X by the learned model.

The plan of (e:LBMPC) keeps the constraints of the *nominal* model, step after step only its first input is certified,
and each new sample mends what h did. Followed blindly it is no more than a guess. So besides it there is a second
problem, solved where there is time, with the same cost and the learned states in the place of the nominal ones:

    min over v      |z_N - x^r|_P^2 + sum_i |z_i - x^r|_Q^2 + |v_i - u^r|_R^2 + |v_i - v_{i-1}|_S^2
    subject to      z_{i+1} = A z_i + B v_i + h_hat(z_i, v_i),
                    v_i in U,   |v_i - v_{i-1}| <= rate T,   z_{i+1} in (1 - margin) X       i = 0 .. N-1

from z_0, the state to which the command that was just given leads, to the target of that command's plan. Its solution
is followed with feedback,

    u_i = v_i + K (x_i - z_i),

which takes no more than the plant's own sensors; the plant keeps u to its range and its rate. K is stiffer than the
model's: what the plan does not know must not add up. Nothing of this is certified: h_hat is what was learned so far.

The margin is room for what h_hat does not know, and where the way to x^r leads along a bound it can cost the way
itself. So where the plan touches its margin and does not lead back, |z_N - x^r|_P >= 0.9 |z_0 - x^r|_P, the problem is
solved again without one, and if that costs less a third time, with as much of it as should lead back. What a plan costs
is the cost above and the penalty for what leaves X itself. Where it ends would not tell: of two plans that are lost,
the one that leaves X at once may end as near as the one that stays at its edge.
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
"""Gauss-Newton steps from the nominal plan, which is near; of what they pass the best is taken."""
RAMP = 4
"""Steps over which the margin grows: at once, it would cost a leap of the input and the swing that follows."""
NEARER = 0.9
"""Of |z_0 - x^r|_P: where a plan that leads back ends at most."""
CHEAPER = 0.9
"""Of the cost with all of the margin: what a plan without one costs at most, to be better."""
TOUCHES = 1e-3
"""Nearer than this share of the half-width to a margin's edge, the plan may be held up by it."""
STIFFNESS = 25.0
"""Weight of the plant's performance states in the LQR that K is, against the input, each in units of its half-width."""


class Rollout(NamedTuple):
    """Inputs v, (N, m), the learned states z_1 .. z_N that they lead to, (N, d), and the cost, without penalties."""

    v: np.ndarray
    z: np.ndarray
    cost: float


@dataclass(frozen=True, eq=False)
class Policy:
    """u_i = inputs[i] + gain x, deviations, for N periods: inputs (N, m), gain (m, d)."""

    inputs: np.ndarray
    gain: np.ndarray
    states: np.ndarray
    """z_0 .. z_{N-1}, which it expects, (N, d)."""
    margin: float
    """By how much they stay inside X, as a share of its half-widths."""


class BackupPlanner:
    """Solves that problem, always with the same number of steps.

    Args:
        problem: what the controller solves; its cost, oracle, horizon and U are taken over.
        margin: by how much X shrinks, as a share of its half-widths, where a plan that leads back is left.
        realise: what turns a CasADi function into the one that is called.
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
        """The policy from the predicted state s, (D,), on.

        Args:
            s: where the command that was just given leads, with its past where the oracle looks back.
            theta: the oracle's parameters.
            plan: the nominal plan from there on, (N, m).
            xr, ur: references as for `lbmpc.solver.gauss_newton.Solver.solve`.
            previous: that command, (m,), as for `Solver.solve`.

        Returns:
            None when the numbers are unusable.
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
        """The share of the margin, and the plan, that leads back, or else what costs less, if anything does.

        Where a plan ends is taken for linear in the margin.
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
        """|z_N|_P of |z_0|_P, both from the last target."""
        inputs, d = self._subproblem.sweep.inputs, self.problem.model.d
        start, target = inputs["x"][:d, 0], inputs["xr"][:, -1]
        return self._norm(rollout.z[-1] - target) / max(self._norm(start - target), np.finfo(float).tiny)

    def _norm(self, x: np.ndarray) -> float:
        """|x|_P of x (d,)."""
        return float(np.sqrt(x @ self.problem.model.P @ x))

    def _best(self, rows: Rows, v: np.ndarray, steps: int) -> Rollout | None:
        """The best of what the steps from v, (N, m), pass; None when its numbers are unusable."""
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
    """The rows of the learned states inside (1 - margin) X."""
    plain = state_set(problem.model)
    inside = margin * row_ranges(plain.F, problem.model.plant.x_scale)
    shares = np.minimum(np.arange(1, problem.horizon + 1) / RAMP, 1.0)
    states = tuple(plain.minus(share * inside, share * inside) for share in shares)
    return Rows(replace(problem, states=states, soft=True, guard=None))


def _between(plain: Rows, kept: Rows, share: float) -> Rows:
    """The rows with this share of the margin, in (0, 1)."""
    rows = kept.fresh()
    both = (plain.lower, kept.lower), (plain.upper, kept.upper)
    rows.lower, rows.upper = ((1.0 - share) * without + share * with_it for without, with_it in both)
    return rows


def _price(rows: Rows, rollout: Rollout) -> float:
    """The cost, and the penalty for what is outside these rows."""
    return rollout.cost + rows.price(rows.values(rollout.v.T, rollout.z.T))


def _touches(rows: Rows, rollout: Rollout) -> bool:
    """Whether a state comes to its bounds anywhere."""
    values, near = rows.values(rollout.v.T, rollout.z.T), TOUCHES * rows.penalty.scale
    near_one = (values < rows.lower + near) | (values > rows.upper - near)
    return bool(near_one[rows.count_inputs :].any())


def tracking_gain(model: Model) -> np.ndarray:
    """K, (m, d), that holds the plant on a trajectory: an LQR with Bryson's weights, in units of the half-widths.

    The model's own K where the Riccati equation has no solution for these weights.
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
