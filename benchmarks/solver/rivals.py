"""The same problem for general solvers: IPOPT, and CasADi's sqpmethod."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from lbmpc.problem import Problem
from lbmpc.solver.constraint_rows import Rows

IPOPT = {
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "print_time": False,
    "ipopt.max_iter": 500,
    # IPOPT otherwise moves the bounds by 1e-8, which shows in the first input.
    "ipopt.bound_relax_factor": 0.0,
}
SQPMETHOD = {
    "print_time": False,
    "print_header": False,
    "print_iteration": False,
    "print_status": False,
    "tol_pr": 1e-6,
    "tol_du": 1e-6,
    "max_iter": 30,
}
QP_SOLVERS: dict[str, dict[str, Any]] = {
    # As this solver uses it: DAQP's own tolerance moves the first input by 5e-6.
    "daqp": {"error_on_fail": False, "daqp": {"primal_tol": 1e-9}},
    "qrqp": {"error_on_fail": False, "print_iter": False, "print_header": False, "print_info": False},
}


@dataclass(frozen=True, eq=False)
class _Written:
    """A nonlinear program with its bounds, and the positions of the inputs among its variables."""

    program: dict[str, ca.MX]
    hessian: ca.MX
    """Gauss-Newton Hessian of the cost."""
    lbx: np.ndarray
    ubx: np.ndarray
    lbg: np.ndarray
    ubg: np.ndarray
    inputs: np.ndarray
    """Indices of v, row by row."""


class Rival:
    """A problem of boxes for a solver of CasADi.

    Args:
        problem: what to solve, states and inputs bounded by boxes.
        plugin: "ipopt", or "sqpmethod".
        multiple_shooting: the states are variables too (sparse), or not (small and dense).
        soft: state bounds with slacks and the exact penalty, as the problem has them; else hard. Where hard
            bounds can be kept both have the same optimum.
        gauss_newton: the Gauss-Newton Hessian instead of the exact one.
        options: of the plugin.
    """

    def __init__(
        self,
        problem: Problem,
        plugin: str,
        multiple_shooting: bool,
        soft: bool,
        gauss_newton: bool,
        options: dict[str, Any],
    ):
        self._problem = problem
        self._multiple = multiple_shooting
        self._slacks = problem.horizon * problem.model.d if soft else 0
        self._stage = _stage(problem)
        self._written = written = (_multiple if multiple_shooting else _single)(problem, self._stage, soft)
        if gauss_newton:
            options = {**options, "hess_lag": _lagrangian_hessian(written, plugin)}
        self._solver = ca.nlpsol("rival", plugin, written.program, options)

    def solve(self, x: np.ndarray, theta: np.ndarray, warm: np.ndarray) -> tuple[np.ndarray, int, bool]:
        """Return inputs (N, m), iterations, and whether the solver reports convergence."""
        written = self._written
        found = self._solver(
            x0=self._guess(x, theta, warm),
            p=np.concatenate([x, theta]),
            lbx=written.lbx,
            ubx=written.ubx,
            lbg=written.lbg,
            ubg=written.ubg,
        )
        stats = self._solver.stats()
        v = np.asarray(found["x"]).ravel()[written.inputs].reshape(warm.shape)
        return v, int(stats["iter_count"]), bool(stats["success"])

    def _guess(self, x: np.ndarray, theta: np.ndarray, warm: np.ndarray) -> np.ndarray:
        model, parts, z, nominal = self._problem.model, [], x, x
        for c in warm:
            v, u = model.K @ nominal + c, model.K @ z + c
            z = np.asarray(self._stage(z, u, theta)).ravel()
            nominal = model.A @ nominal + model.B @ v
            parts += [u, z, nominal] if self._multiple else [v]
        return np.concatenate([*parts, np.full(self._slacks, 1e-3)])


def ipopt(problem: Problem, soft: bool, gauss_newton: bool) -> Rival:
    """IPOPT in multiple shooting, several times faster here than in single shooting; its own tolerance, 1e-8.

    The cost is per second: a stage's weights, and with them what IPOPT compares, decrease with the period.
    """
    options = {**IPOPT, "ipopt.tol": 1e-8 * problem.model.period}
    return Rival(problem, "ipopt", True, soft, gauss_newton, options)


def sqpmethod(problem: Problem, qp: str) -> Rival:
    """CasADi's sqpmethod with the Gauss-Newton Hessian and hard bounds: condensed for DAQP, sparse for qrqp."""
    options = {**SQPMETHOD, "qpsol": qp, "qpsol_options": QP_SOLVERS[qp]}
    return Rival(problem, "sqpmethod", qp != "daqp", False, True, options)


def _stage(problem: Problem) -> ca.Function:
    """(z, u, theta) -> A z + B u + h_hat(z, u)."""
    model, oracle = problem.model, problem.oracle
    z, v, theta = (
        ca.MX.sym("z", model.d),
        ca.MX.sym("v", model.m),
        ca.MX.sym("theta", oracle.parameters),
    )
    learned = oracle.value(ca.vertcat(z, v), oracle.split(theta))
    return ca.Function("stage", [z, v, theta], [ca.DM(model.A) @ z + ca.DM(model.B) @ v + learned])


def _multiple(problem: Problem, stage: ca.Function, soft: bool) -> _Written:
    """Variables (u_i, z_{i+1}, zbar_{i+1}) stage by stage, then slacks."""
    model, n = problem.model, problem.horizon
    d, m = model.d, model.m
    x, theta = ca.MX.sym("x", d), ca.MX.sym("theta", problem.oracle.parameters)
    a, b, q, r, p = (ca.DM(matrix) for matrix in (model.A, model.B, model.Q, model.R, model.P))
    z, nominal, cost = x, x, ca.MX(0)
    gain = ca.DM(model.K)
    variables, gaps, blocks, nominals, inputs = [], [], [], [], []
    free = np.full(d, np.inf)
    lower, upper = [], []
    for i in range(n):
        u, z_next, nominal_next = ca.MX.sym("u", m), ca.MX.sym("z", d), ca.MX.sym("zbar", d)
        inputs.append(u - gain @ (z - nominal))
        gaps += [stage(z, u, theta) - z_next, a @ nominal + b @ inputs[i] - nominal_next]
        cost += 0.5 * (ca.bilin(q, z, z) + ca.bilin(r, u, u))
        variables += [u, z_next, nominal_next]
        blocks += [r, p if i == n - 1 else q, ca.DM(d, d)]
        states = problem.states[i]
        lower += [np.full(m, -np.inf), -free, -free if soft else states.lower]
        upper += [np.full(m, np.inf), free, free if soft else states.upper]
        z, nominal = z_next, nominal_next
        nominals.append(nominal)
    cost += 0.5 * ca.bilin(p, z, z)
    zeros = np.zeros(2 * d * n)
    written = _Written(
        {"x": ca.vertcat(*variables), "p": ca.vertcat(x, theta), "f": cost, "g": ca.vertcat(*gaps, *inputs)},
        ca.diagcat(*blocks),
        np.concatenate(lower),
        np.concatenate(upper),
        np.concatenate([zeros, *(part.lower for part in problem.inputs)]),
        np.concatenate([zeros, *(part.upper for part in problem.inputs)]),
        (np.arange(n)[:, None] * (m + 2 * d) + np.arange(m)).ravel(),
    )
    return _softened(problem, written, ca.vertcat(*nominals)) if soft else written


def _single(problem: Problem, stage: ca.Function, soft: bool) -> _Written:
    """Variables v alone; the states follow from them."""
    if soft:
        raise ValueError("single shooting is written with hard bounds only")
    model, n = problem.model, problem.horizon
    x, theta = ca.MX.sym("x", model.d), ca.MX.sym("theta", problem.oracle.parameters)
    a, b = ca.DM(model.A), ca.DM(model.B)
    # Cholesky factors: the cost as a sum of squares, whose Jacobian gives the Gauss-Newton Hessian.
    q, r, p = (ca.DM(np.linalg.cholesky(matrix).T) for matrix in (model.Q, model.R, model.P))
    v = ca.MX.sym("v", model.m, n)
    z, nominal, residuals, rows = x, x, [], []
    for i in range(n):
        u = v[:, i] + ca.DM(model.K) @ (z - nominal)
        residuals += [q @ z, r @ u]
        z, nominal = stage(z, u, theta), a @ nominal + b @ v[:, i]
        rows.append(nominal)
    residual = ca.vertcat(*residuals, p @ z)
    decision = ca.vec(v)
    jacobian = ca.jacobian(residual, decision)
    return _Written(
        {
            "x": decision,
            "p": ca.vertcat(x, theta),
            "f": 0.5 * ca.sumsqr(residual),
            "g": ca.vertcat(*rows),
        },
        jacobian.T @ jacobian,
        np.concatenate([part.lower for part in problem.inputs]),
        np.concatenate([part.upper for part in problem.inputs]),
        np.concatenate([part.lower for part in problem.states]),
        np.concatenate([part.upper for part in problem.states]),
        np.arange(model.m * n),
    )


def _softened(problem: Problem, written: _Written, nominal: ca.MX) -> _Written:
    """State bounds as rows with slacks e >= 0, in units of each row's scale, with the penalty (e + e^2 / 2)."""
    rows = Rows(problem)
    count = rows.count_inputs
    scale, lower, upper = rows.penalty.scale[count:], rows.lower[count:], rows.upper[count:]
    e = ca.MX.sym("e", len(scale))
    weight = problem.penalty * problem.model.cost_scale
    price = weight * ca.sum1(e + 0.5 * e**2)
    program = {
        **written.program,
        "x": ca.vertcat(written.program["x"], e),
        "f": written.program["f"] + price,
        "g": ca.vertcat(written.program["g"], nominal - scale * e, nominal + scale * e),
    }
    unbounded = np.full(len(scale), np.inf)
    return _Written(
        program,
        ca.diagcat(written.hessian, weight * ca.DM.eye(len(scale))),
        np.concatenate([written.lbx, np.zeros(len(scale))]),
        np.concatenate([written.ubx, unbounded]),
        np.concatenate([written.lbg, -unbounded, lower]),
        np.concatenate([written.ubg, upper, unbounded]),
        written.inputs,
    )


def _lagrangian_hessian(written: _Written, plugin: str) -> ca.Function:
    """The Gauss-Newton Hessian under the name and the shape that the plugin expects."""
    program = written.program
    factor, multipliers = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", program["g"].shape[0])
    hessian, name = factor * written.hessian, "hess_gamma_x_x"
    if plugin == "ipopt":
        hessian, name = ca.triu(hessian), "triu_hess_gamma_x_x"
    return ca.Function(
        "nlp_hess_l",
        [program["x"], program["p"], factor, multipliers],
        [hessian],
        ["x", "p", "lam_f", "lam_g"],
        [name],
    )
