"""Solves (e:LBMPC) by a feasible Gauss-Newton SQP whose iterations are limited by number, never by time.

The constraints are linear with constant matrices and do not depend on the oracle, so every iterate after the first step
satisfies them. Stopping early costs optimality but not safety, and a wrong oracle costs performance but never violates
a hard constraint. If the oracle gives numbers that cannot be used, the nominal model replaces it for that solve.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import isfinite

import casadi as ca
import numpy as np

from lbmpc.casadi_buffers import Bound
from lbmpc.oracles.base import Oracle, remembered
from lbmpc.oracles.linear import LinearOracle
from lbmpc.problem import Problem
from lbmpc.solver.constraint_rows import Box, Rows
from lbmpc.solver.least_distance import NO_ROWS, Shown
from lbmpc.solver.nominal_rollout import build_nominal, build_start
from lbmpc.solver.riccati import build_rows, build_sweep, build_tangent, with_input
from lbmpc.solver.solution import Solution, Status
from lbmpc.solver.subproblem import Subproblem, Target, finite

MAX_HALVINGS = 12
# A step that shrinks this fast is extrapolated: the next one will be smaller by the same factor.
FAST = 0.1


@dataclass(frozen=True, eq=False)
class Prepared:
    """A linearisation about a predicted state, to be completed with the measured one."""

    s: np.ndarray
    """Predicted state, (D,), followed by the previous input, (m,), if changes have a cost; D then includes it."""
    first: Box
    """Bounds on v_0."""
    status: Status
    cost: float
    values: np.ndarray
    """Row values at w = 0 and s, (rows,)."""
    slopes: np.ndarray
    """Their slopes in w, (rows, m N)."""
    follow: np.ndarray
    """Their slopes in s, (rows, D)."""
    free: np.ndarray
    """The unconstrained minimiser's inputs, (N, m)."""
    slopes_v: np.ndarray
    """Slopes of these inputs in w, (m N, m N)."""
    follow_v: np.ndarray
    """Slopes of these inputs in s, (m N, D)."""
    steered: np.ndarray
    """The inputs of the minimiser's learned trajectory, (N, m)."""
    slopes_u: np.ndarray
    """Slopes of these inputs in w, (m N, m N)."""
    follow_u: np.ndarray
    """Slopes of these inputs in s, (m N, D)."""
    shown: Shown | None
    """The QP as solved at s; None if no row was violated there."""


class Solver:
    """Solves one problem repeatedly for new states, parameters and references.

    Args:
        problem: the problem. Nothing of it is rebuilt later.
        max_iterations: Gauss-Newton steps per solve, at least 1.
        tolerance: the solve has converged if no input of the plan moves by more, as a share of its half-width.
        realise: turns a CasADi function into the function that is called, for example by compiling it.
    """

    def __init__(
        self,
        problem: Problem,
        max_iterations: int = 10,
        tolerance: float = 1e-6,
        realise: Callable[[ca.Function], ca.Function] = lambda function: function,
    ):
        self.problem = problem
        self.max_iterations, self.tolerance = max_iterations, tolerance
        self._realise = realise
        self._rows = Rows(problem)
        plant = problem.model.plant
        self._per_input = 1.0 / plant.u_scale
        self._u_min, self._u_max = plant.u_min - plant.u_e, plant.u_max - plant.u_e
        self._behind = remembered(problem.oracle)
        self._move = Bound(realise(build_rows(problem.model, problem.horizon, self._behind)))
        self._learned = self._subproblem(problem.oracle)
        nominal = LinearOracle(problem.model.d, problem.model.m, problem.oracle.pairs)
        same = problem.oracle.name == nominal.name
        self._nominal = self._learned if same else self._subproblem(nominal)
        self._follow = Bound(realise(build_nominal(problem)))
        self._begin = Bound(realise(build_start(problem)))
        # Built at the first preparation, because a controller that solves to convergence does not need it.
        self._tangent: Bound | None = None
        self._prepared: Prepared | None = None

    def _subproblem(self, oracle: Oracle) -> Subproblem:
        sweep = Bound(self._realise(build_sweep(self.problem.model, oracle, self.problem.horizon)))
        return Subproblem(sweep, self._move)

    def solve(
        self,
        x: np.ndarray,
        oracle_parameters: np.ndarray,
        warm_start: np.ndarray,
        xr: np.ndarray | None = None,
        ur: np.ndarray | None = None,
        first: Box | None = None,
        previous: np.ndarray | None = None,
    ) -> Solution:
        """Minimise from x_t = x.

        Args:
            x: measured state, (d,), in deviations. For an oracle with a window, the past pairs follow: s of
                `lbmpc.oracles.base`, (D,).
            oracle_parameters: theta, as packed by the oracle.
            warm_start: initial c, (N, m), for example that of an earlier solution; it may be infeasible.
            xr, ur: references over the horizon, (N + 1, d) and (N, m), or one row for the whole horizon; the
                equilibrium by default.
            first: hard bounds on v_0 for this solve, (m,) each, inside U; U by default.
            previous: the present input, (m,), as v_{-1} and u_{-1}; the equilibrium input by default. It has no effect
                without rate limits and S.

        Returns:
            A `Solution`. The method never raises because of its numbers.
        """
        self._rows.bound_first(first, previous)
        # An oracle with bad numbers may overflow before it is refused.
        with np.errstate(all="ignore"):
            start = self._start(x, warm_start)
            s = with_input(self.problem.model, x, previous)
            self._learned.load(s, oracle_parameters, xr, ur)
            solution = self._solve(self._learned, x, start)
            if solution.usable or self._learned is self._nominal:
                return solution
            self._nominal.load(s, np.zeros(0), xr, ur)
            nominal = self._solve(self._nominal, x, start)
            return replace(nominal, status=Status.ORACLE_REFUSED) if nominal.usable else nominal

    # -- real-time iteration --------------------------------------------------------------------------------

    def prepare(
        self,
        x: np.ndarray,
        oracle_parameters: np.ndarray,
        warm_start: np.ndarray,
        xr: np.ndarray | None = None,
        ur: np.ndarray | None = None,
        previous: np.ndarray | None = None,
    ) -> None:
        """Linearise about a predicted state x, (D,), and do all work that does not need x_t.

        Arguments as for `solve`; `previous` is the input that will act then. `feedback` completes the Gauss-Newton
        step.
        """
        if self._tangent is None:
            function = build_tangent(self.problem.model, self.problem.horizon, self._behind)
            self._tangent = Bound(self._realise(function))
        self._rows.bound_first(None, previous)
        rows, s = self._rows, with_input(self.problem.model, x, previous)
        with np.errstate(all="ignore"):
            v, status = self._start(x, warm_start), Status.NUMERICAL
            for subproblem, theta, trusted in (
                (self._learned, oracle_parameters, Status.REAL_TIME),
                (self._nominal, np.zeros(0), Status.ORACLE_REFUSED),
            ):
                subproblem.load(s, theta, xr, ur)
                cost = subproblem.linearise(v)
                if isfinite(cost) and finite(subproblem.sweep.outputs["zs"]):
                    status = trusted
                    break
            moved = subproblem.propagate(self._tangent)
            slopes, follow = moved["M"].T, moved["Y"].T
            values, all_slopes = subproblem.values(rows), rows.apply(slopes)
            guess = None
            if status is not Status.NUMERICAL and not rows.kept(values):
                # The same rows will usually be active at the measured state.
                guess, _feasible = rows.nearest(values, all_slopes)
            self._prepared = Prepared(
                np.array(s, dtype=float),
                (rows.first[0].copy(), rows.first[1].copy()),
                status,
                cost,
                values,
                all_slopes,
                rows.apply(follow),
                subproblem.free.copy(),
                slopes[: v.size],
                follow[: v.size],
                subproblem.steered.copy(),
                moved["U"].T.copy(),
                moved["X"].T.copy(),
                guess.shown if guess is not None and not rows.ordered else None,
            )

    def feedback(
        self, x: np.ndarray, first: Box | None = None, previous: np.ndarray | None = None
    ) -> Solution:
        """Complete the prepared step for the measured state x, (D,), with a correction for x and a small QP.

        `first` is that of `solve`; it depends on x and is therefore not known in the preparation. `previous` is needed
        if another input acts than the one given to the preparation.

        The nominal trajectory is linear in x, so the constraints hold for x itself and not only for its prediction.

        Raises:
            RuntimeError: nothing was prepared.
        """
        # A preparation is used once. A QP that is solved twice keeps memory, and equal calls must give equal bits.
        ready, self._prepared = self._prepared, None
        if ready is None:
            raise RuntimeError("feedback without preparation: call prepare first")
        s = with_input(self.problem.model, np.asarray(x, dtype=float), previous)
        rows, change = self._rows, s - ready.s
        rows.bound_first(first, previous)
        with np.errstate(all="ignore"):
            values = ready.values + ready.follow.dot(change)
            shape, status = ready.free.shape, ready.status
            v = ready.free + ready.follow_v.dot(change).reshape(shape)
            u = ready.steered + ready.follow_u.dot(change).reshape(shape)
            if status is Status.NUMERICAL or not finite(values):
                return self._finish(Status.NUMERICAL, x, ready.free, ready.steered, np.inf, 0)
            if not rows.kept(values):
                shown, hint = ready.shown, NO_ROWS
                others = first is not None or not np.array_equal(rows.first, ready.first)
                if shown is not None and others and (shown.seen < rows.m).any():
                    # The QP was set up with other bounds on v_0.
                    hint, shown = shown.seen, None
                nearest, feasible = rows.nearest(values, ready.slopes, hint, shown)
                if nearest is None:
                    return self._finish(Status.NUMERICAL, x, ready.free, ready.steered, np.inf, 1)
                v = rows.clip(v + (ready.slopes_v @ nearest.w).reshape(shape))
                u = u + (ready.slopes_u @ nearest.w).reshape(shape)
                status = status if feasible else Status.INFEASIBLE
            return self._finish(status, x, v, u, ready.cost, 1)

    # -- to convergence --------------------------------------------------------------------------------------

    def _solve(self, subproblem: Subproblem, x: np.ndarray, v: np.ndarray) -> Solution:
        """Iterate from inputs v, (N, m), inside their bounds, with the loaded data."""
        merit, u = np.inf, v
        subproblem.linearise(v)
        status, values, seen = Status.ITERATION_LIMIT, self._rollout(x, v)["values"][:, 0].copy(), NO_ROWS
        iterations, size, whole, share = 0, 0.0, np.zeros_like(v), 1.0
        while iterations < self.max_iterations:
            iterations += 1
            target = self._target(subproblem, seen)
            if target is None:
                break
            seen = target.seen
            arrived = Status.CONVERGED if target.feasible else Status.INFEASIBLE
            if not target.feasible:
                status = arrived
            step = target.v - v
            size, before = self._size(step), size
            rate = size / before if before > 0 else np.inf
            if np.isfinite(merit) and (
                size < self.tolerance or (rate < FAST and size * rate < self.tolerance)
            ):
                # The remaining distance does not justify another linearisation. v is feasible.
                v, u, status = target.v, target.u, arrived
                break
            # The first step leads into the feasible set. After it, the true cost must decrease.
            trial, trial_u, trial_values = target.v, target.u, target.values
            scaled = step * self._per_input
            share, whole = _share(scaled, whole, share), scaled
            if share < 1.0:
                step = share * step
                trial, trial_u = v + step, u + share * (trial_u - u)
                trial_values = values + share * (trial_values - values)
            trial_merit = self._merit(subproblem, trial, trial_values)
            if not np.isfinite(trial_merit):
                break
            if subproblem is self._nominal:
                # For a linear model the step is exact.
                v, u, merit, status = trial, trial_u, trial_merit, arrived
                break
            halvings = 0
            while trial_merit > merit and halvings < MAX_HALVINGS and self._size(step) >= self.tolerance:
                # The rows are linear in v, so half a step gives half the change.
                step, share, halvings = 0.5 * step, 0.5 * share, halvings + 1
                trial, trial_u = v + step, 0.5 * (u + trial_u)
                trial_values = 0.5 * (values + trial_values)
                trial_merit = self._merit(subproblem, trial, trial_values)
            if not trial_merit <= merit:
                # No descent is possible at this precision, so v is optimal for this linearisation.
                status = arrived
                break
            v, u, values, merit = trial, trial_u, trial_values, trial_merit
            if self._size(step) < self.tolerance:
                status = arrived
                break
        return self._finish(status, x, v, u, merit, iterations)

    def _size(self, step: np.ndarray) -> float:
        """Return the largest entry of a step in the inputs, (N, m), as a share of the input's half-width."""
        return float((np.abs(step) * self._per_input).max())

    def _merit(self, subproblem: Subproblem, v: np.ndarray, values: np.ndarray) -> float:
        """Linearise at v, (N, m), with row values (rows,), and return its true cost with soft constraints, or inf.

        The cost is in units of the model's `cost_scale`, like all costs in this module.
        """
        total = subproblem.linearise(v) + self._rows.price(values)
        return total if np.isfinite(total) else np.inf

    def _target(self, subproblem: Subproblem, hint: np.ndarray) -> Target | None:
        """Return the minimiser of the linearised problem; None if the numbers are not finite."""
        values = subproblem.values(self._rows)
        if not finite(values):
            return None
        if self._rows.kept(values):
            return Target(subproblem.free.copy(), subproblem.steered.copy(), values, True, hint)
        return subproblem.constrained(self._rows, values, hint)

    def _start(self, x: np.ndarray, c: np.ndarray) -> np.ndarray:
        """Return inputs inside their bounds, (N, m), from x or s with c, (N, m)."""
        inputs = self._begin.inputs
        inputs["x"][:, 0], inputs["c"][:] = x[: self.problem.model.d], _numbers(c).T
        inputs["lower"][:, 0], inputs["upper"][:, 0] = self._rows.first
        self._begin()
        return self._rows.clip(_numbers(self._begin.outputs["v"].T))

    def _rollout(self, x: np.ndarray, v: np.ndarray) -> dict[str, np.ndarray]:
        """Return `lbmpc.solver.nominal_rollout` for inputs v, (N, m), from x or s; valid until the next call."""
        inputs, rows = self._follow.inputs, self._rows
        inputs["x"][:, 0], inputs["v"][:] = x[: self.problem.model.d], v.T
        inputs["lower"][:, 0], inputs["upper"][:, 0] = rows.lower, rows.upper
        self._follow()
        return self._follow.outputs

    def _finish(
        self, status: Status, x: np.ndarray, v: np.ndarray, u: np.ndarray, merit: float, iterations: int
    ) -> Solution:
        found = self._rollout(x, v)
        slack, slack_row = self._rows.slack(found["outside"][:, 0])
        hard_broken = not self.problem.soft and status is not Status.INFEASIBLE and slack > 0.0
        if not isfinite(merit) or not isfinite(found["total"][0, 0]) or hard_broken:
            status = Status.NUMERICAL
        elif slack > 0.0 and status in (Status.CONVERGED, Status.REAL_TIME):
            status = Status.INFEASIBLE
        u = np.minimum(np.maximum(u, self._u_min), self._u_max)
        # Both trajectories begin at x_t, so bounds on v_0 are bounds on u_0.
        u[0] = v[0]
        u = self._rows.within_steps(u)
        cost = merit * self.problem.model.cost_scale
        c, zbar = found["c"].T.copy(), found["zbar"].T.copy()
        return Solution(status, v, c, u, zbar, cost, iterations, slack, slack_row)


def _share(step: np.ndarray, before: np.ndarray, taken: float) -> float:
    """Return the share of a step to take, at most 1, after the share `taken` of the step `before`; (N, m), scaled.

    Gauss-Newton neglects the curvature of h_hat. If the true curvature is 1 + a times as large, a share t of a step
    leaves 1 - t (1 + a) of the distance. Two steps determine a, and the best share is 1 / (1 + a) (Aitken).
    """
    length = float((before * before).sum())
    left = float((step * before).sum()) / length if length > 0.0 else 0.0
    return taken / (1.0 - left) if left < 1.0 - taken else 1.0


def _numbers(v: np.ndarray) -> np.ndarray:
    """Return `v` with NaN and infinities replaced. The check first takes a tenth of the time."""
    return v if finite(v) else np.nan_to_num(v)
