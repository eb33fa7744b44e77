"""Problem (e:LBMPC) solved by IPOPT, as the reference for `lbmpc.solver.gauss_newton`."""

from __future__ import annotations

import casadi as ca
import numpy as np

from lbmpc.oracles.base import follow_symbols, remembered
from lbmpc.problem import Problem
from lbmpc.solver.constraint_rows import Rows
from lbmpc.solver.least_distance import violation
from lbmpc.solver.solution import Solution, Status


class ReferenceSolver:
    """The same problem in full, with slacks, exact Hessians and tight tolerances."""

    def __init__(self, problem: Problem, tolerance: float = 1e-10):
        self.problem = problem
        self._rows = rows = Rows(problem)
        model, n = problem.model, problem.horizon
        d, m = model.d, model.m
        x, theta = (
            ca.MX.sym("x", d + remembered(problem.oracle)),
            ca.MX.sym("theta", problem.oracle.parameters),
        )
        v = ca.MX.sym("v", m, n)
        e = ca.MX.sym("e", int(rows.penalty.soft.sum()) if problem.soft else 0)
        before = ca.MX.sym("before", m)
        a, b, q, r, p = (ca.DM(matrix) for matrix in (model.A, model.B, model.Q, model.R, model.P))
        parts = problem.oracle.split(theta)
        s, nominal, cost = x, x[:d], ca.MX(0)
        u_before, values_v, values_z = before, [], []
        for i in range(n):
            vi, z = v[:, i], s[:d]
            ui = vi + ca.DM(model.K) @ (z - nominal)
            cost += 0.5 * (ca.bilin(q, z, z) + ca.bilin(r, ui, ui))
            cost += 0.5 * ca.bilin(ca.DM(model.S), ui - u_before, ui - u_before)
            u_before = ui
            after = a @ z + b @ ui + problem.oracle.value(ca.vertcat(s, ui), parts)
            s = follow_symbols(s, ui, after)
            nominal = a @ nominal + b @ vi
            values_v.append(ca.DM(rows.input_rows) @ vi)
            values_z.append(ca.DM(rows.state_rows) @ nominal)
        cost += 0.5 * ca.bilin(p, s[:d], s[:d])
        limited = np.flatnonzero(np.isfinite(problem.input_steps)).tolist()
        changes = [(v[:, i] - v[:, i - 1])[limited] for i in range(1, n) if limited]
        values = ca.vertcat(*values_v, *changes, *values_z, ca.DM(rows.terminal_rows) @ nominal)
        count = rows.count_inputs
        slack = (
            ca.DM(rows.penalty.scale[count:]) * e if problem.soft else ca.DM.zeros(values.shape[0] - count)
        )
        cost += problem.penalty * model.cost_scale * ca.sum1(e + 0.5 * e**2)
        g = ca.vertcat(values[:count], values[count:] - slack, values[count:] + slack)
        self._lower = np.concatenate(
            [rows.lower[:count], np.full(len(rows.lower) - count, -np.inf), rows.lower[count:]]
        )
        self._upper = np.concatenate(
            [rows.upper[:count], rows.upper[count:], np.full(len(rows.upper) - count, np.inf)]
        )
        options = {
            "ipopt.print_level": 0,
            "print_time": False,
            "ipopt.sb": "yes",
            # Scale of the cost, which shrinks with the period.
            "ipopt.tol": tolerance * model.period,
            "ipopt.constr_viol_tol": tolerance,
            # By default IPOPT relaxes the bounds by 1e-8.
            "ipopt.bound_relax_factor": 0.0,
            "ipopt.max_iter": 500,
        }
        decision = ca.vertcat(ca.vec(v), e)
        self._solver = ca.nlpsol(
            "r", "ipopt", {"x": decision, "f": cost, "g": g, "p": ca.vertcat(x, theta, before)}, options
        )
        self._lbx = np.concatenate([np.full(m * n, -np.inf), np.zeros(e.shape[0])])

    def solve(
        self,
        x: np.ndarray,
        oracle_parameters: np.ndarray,
        warm_start: np.ndarray,
        within: float = np.inf,
        previous: np.ndarray | None = None,
    ) -> Solution:
        """Solve as `lbmpc.solver.gauss_newton.Solver.solve`; `within` limits the distance from the warm start.

        A nonconvex problem has several minima, and an interior-point method may leave the one near its start.
        """
        n, m = self.problem.horizon, self.problem.model.m
        model = self.problem.model
        guess, state = np.zeros((n, m)), np.asarray(x, dtype=float)[: model.d]
        for i, c in enumerate(warm_start):
            guess[i] = model.K @ state + c
            state = model.A @ state + model.B @ guess[i]
        guess = np.concatenate([np.ravel(guess), np.full(len(self._lbx) - n * m, 1e-3)])
        before = np.zeros(m) if previous is None else previous
        self._rows.bound_first(None, before)
        self._lower[:m], self._upper[:m] = self._rows.first
        result = self._solver(
            x0=guess,
            p=np.concatenate([x, oracle_parameters, before]),
            lbg=self._lower,
            ubg=self._upper,
            lbx=self._lbx,
        )
        v = np.array(result["x"]).ravel()[: n * m].reshape(n, m)
        zbar, c, state = np.zeros((n, model.d)), np.zeros((n, m)), np.asarray(x, dtype=float)[: model.d]
        for i in range(n):
            c[i] = v[i] - model.K @ state
            state = zbar[i] = model.A @ state + model.B @ v[i]
        slack, row = self._rows.slack(
            violation(self._rows.values(v.T, zbar.T), self._rows.lower, self._rows.upper)
        )
        stats = self._solver.stats()
        status = Status.CONVERGED if stats["success"] else Status.NUMERICAL
        return Solution(
            status, v, c, np.empty((0, m)), zbar, float(result["f"]), int(stats["iter_count"]), slack, row
        )
