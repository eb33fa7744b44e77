"""Solves (e:LBMPC) by a feasible Gauss-Newton SQP, bounded in iterations and never by the clock.

The constraints are linear with constant matrices and do not see the oracle, so from the first step on every iterate
keeps them: stopping early costs optimality, never safety, and a lying oracle costs performance, never a hard
constraint. An oracle whose numbers cannot be used at all is set aside for that solve, in favour of the nominal model.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lbmpc.bound import Bound
from lbmpc.kernels import build_rows, build_sweep
from lbmpc.least_distance import PRIMAL_TOLERANCE, least_distance, violation
from lbmpc.oracles.base import LinearOracle, Oracle
from lbmpc.problem import Problem
from lbmpc.rows import Rows
from lbmpc.solution import Solution, Status

# Above the QP's own tolerance; what a hard row may be off by before a solution is refused.
HARD_TOLERANCE = 1e-7
MAX_HALVINGS = 12


class Solver:
    """One problem, solved again and again from new states, parameters and references.

    Args:
        problem: what to solve; nothing in it is rebuilt later.
        max_iterations: Gauss-Newton steps in one solve, at least 1.
        tolerance: converged when no input of the plan moves by more (input units).
    """

    def __init__(self, problem: Problem, max_iterations: int = 10, tolerance: float = 1e-6):
        self.problem = problem
        self.max_iterations, self.tolerance = max_iterations, tolerance
        self._rows = Rows(problem)
        self._move = Bound(build_rows(problem.model, problem.horizon))
        self._sweep = self._bind(problem.oracle)
        nominal = LinearOracle(problem.model.d, problem.model.m)
        self._nominal_sweep = self._sweep if problem.oracle.name == nominal.name else self._bind(nominal)
        self._free, self._forced = _prediction(problem)

    def _bind(self, oracle: Oracle) -> Bound:
        return Bound(build_sweep(self.problem.model, oracle, self.problem.horizon))

    def solve(
        self,
        x: np.ndarray,
        oracle_parameters: np.ndarray,
        warm_start: np.ndarray,
        xr: np.ndarray | None = None,
        ur: np.ndarray | None = None,
    ) -> Solution:
        """Minimise from x_t = x.

        Args:
            x: measured state, (d,), deviation coordinates.
            oracle_parameters: theta, as the oracle packs it.
            warm_start: inputs to start from, (N, m); they need not be feasible.
            xr, ur: references over the horizon, (N + 1, d) and (N, m); the equilibrium by default.

        Returns:
            A `Solution`; never raises for numbers, whatever they are.
        """
        # Wild oracles overflow on their way to being refused.
        with np.errstate(all="ignore"):
            solution = self._solve(self._sweep, x, oracle_parameters, warm_start, xr, ur)
            if solution.usable or self._sweep is self._nominal_sweep:
                return solution
            nominal = self._solve(self._nominal_sweep, x, np.zeros(0), warm_start, xr, ur)
            return replace(nominal, status=Status.ORACLE_REFUSED) if nominal.usable else nominal

    def _solve(
        self,
        sweep: Bound,
        x: np.ndarray,
        theta: np.ndarray,
        warm_start: np.ndarray,
        xr: np.ndarray | None,
        ur: np.ndarray | None,
    ) -> Solution:
        sweep.inputs["x"][:, 0] = x
        sweep.inputs["theta"][:, 0] = theta
        sweep.inputs["xr"][:] = 0.0 if xr is None else np.asarray(xr).T
        sweep.inputs["ur"][:] = 0.0 if ur is None else np.asarray(ur).T
        v, merit = self._rows.clip(np.nan_to_num(warm_start)), np.inf
        status = Status.ITERATION_LIMIT
        self._evaluate(sweep, x, v)
        iterations = 0
        while iterations < self.max_iterations:
            iterations += 1
            target, feasible = self._subproblem(sweep)
            if target is None:
                break
            target = self._rows.clip(target)
            if not feasible:
                status = Status.INFEASIBLE
            # The first step leads into the feasible set; after it the true cost must fall.
            step, trial_merit = target - v, self._evaluate(sweep, x, target)
            if not np.isfinite(trial_merit):
                break
            halvings = 0
            while trial_merit > merit and halvings < MAX_HALVINGS and np.abs(step).max() >= self.tolerance:
                step, halvings = 0.5 * step, halvings + 1
                trial_merit = self._evaluate(sweep, x, v + step)
            if not trial_merit <= merit:
                # No descent is left at this precision: v is as good as this linearisation can tell.
                status = Status.CONVERGED if feasible else status
                break
            v = target if halvings == 0 else v + step
            merit = trial_merit
            if np.abs(step).max() < self.tolerance:
                status = Status.CONVERGED if feasible else status
                break
        return self._finish(status, x, v, merit, iterations)

    def _evaluate(self, sweep: Bound, x: np.ndarray, v: np.ndarray) -> float:
        """Linearise at v, (N, m), and return its true cost, soft constraints included; inf when not usable."""
        sweep.inputs["v"][:] = v.T
        sweep()
        cost = float(sweep.outputs["cost"][0, 0])
        outside = violation(self._rows.values(v.T, self._nominal(x, v)), self._rows.lower, self._rows.upper)
        total = cost + self._rows.penalty.cost(outside)
        return total if np.isfinite(total) else np.inf

    def _subproblem(self, sweep: Bound) -> tuple[np.ndarray | None, bool]:
        """The minimiser (N, m) of the linearised problem, and whether hard state rows can be met."""
        rows, outputs = self._rows, sweep.outputs
        free = outputs["vs"]
        values = rows.values(free, outputs["zs"])
        if not np.isfinite(values).all():
            return None, True
        if (violation(values, rows.lower, rows.upper) <= PRIMAL_TOLERANCE).all():
            return free.T.copy(), True
        for name in "ABKL":
            self._move.inputs[name][:] = outputs[name]
        self._move()
        mv, mz = self._move.outputs["Mv"], self._move.outputs["Mz"]
        slopes = rows.slopes(mv, mz)
        soft = self.problem.soft
        w = least_distance(values, slopes, rows.lower, rows.upper, rows.penalty if soft else None)
        feasible = w is not None or soft
        if w is None and not soft:
            w = least_distance(values, slopes, rows.lower, rows.upper, rows.penalty)
        return (None if w is None else free.T + (mv @ w).reshape(free.T.shape)), feasible

    def _nominal(self, x: np.ndarray, v: np.ndarray) -> np.ndarray:
        """zbar_1..zbar_N under inputs v, (d, N)."""
        return (self._free @ x + self._forced @ v.ravel()).reshape(len(v), -1).T

    def _finish(
        self, status: Status, x: np.ndarray, v: np.ndarray, merit: float, iterations: int
    ) -> Solution:
        zbar = self._nominal(x, v)
        values = self._rows.values(v.T, zbar)
        slack, slack_row = self._rows.slack(values)
        hard_broken = not self.problem.soft and status is not Status.INFEASIBLE and slack > HARD_TOLERANCE
        if not np.isfinite(merit) or not np.isfinite(values).all() or hard_broken:
            status = Status.NUMERICAL
        return Solution(status, v, zbar.T.copy(), merit, iterations, slack, slack_row)


def _prediction(problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    """zbar_1..zbar_N, step by step, as matrices of x (d N, d) and of v (d N, m N)."""
    model, n = problem.model, problem.horizon
    d, m = model.d, model.m
    free, forced = np.zeros((n, d, d)), np.zeros((n, d, m * n))
    power, response = np.eye(d), np.zeros((d, m * n))
    for i in range(n):
        power, response = model.A @ power, model.A @ response
        response[:, m * i : m * (i + 1)] += model.B
        free[i], forced[i] = power, response
    return free.reshape(n * d, d), forced.reshape(n * d, m * n)
