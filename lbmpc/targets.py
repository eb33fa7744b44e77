"""Target selection of offset-free MPC with the learned model: the rest that a plan leads to.

    min over x, u   |C x - r|^2 + SECOND (|x|_Q^2 + |u|_R^2)
    subject to      (A - I) x + B u + h_hat(x, u) = v,   x in Z,   u in V

in deviation coordinates, in half-widths. Q and R are those of the cost, Z and V the tightened X and U of the problem.
The outputs C x have precedence: they equal r if the learned model has such a rest, and are as near as possible
otherwise. Among all equally good rests the target has the least cost about the equilibrium; without outputs it has the
least cost of all rests (Muske and Rawlings 1993; Pannocchia and Rawlings 2003). v is 0 except for a moving reference.
There it is the motion of the rest per period, so that a plant at the target moves with it.

A few Newton steps from the last target solve the problem, limited by number and never by time. Each step is an equality
constrained least-squares problem. If its solution violates the rows, a QP with as many variables as inputs follows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import isfinite
from typing import Literal

import casadi as ca
import numpy as np

from lbmpc.casadi_buffers import Bound
from lbmpc.oracles.base import Oracle
from lbmpc.problem import Problem
from lbmpc.sets.geometry.polytope import row_ranges
from lbmpc.solver.least_distance import Penalty, least_distance, violation

STEPS = 5
"""Largest number of Newton steps per search. The next search continues from the result."""
ARRIVED = 1e-5
"""Half-widths. The error after a shorter step is the square of its length."""
INSIDE = 1e-6
"""Share of a row's range by which a rest may be outside Z or V, because of a QP's tolerance."""
REACHED = 1e-4
"""Half-widths. Outputs this close to r count as reached."""
SECOND = 1e-8
"""Weight of the cost relative to that of the outputs. It moves the outputs by a negligible amount."""
LEAST = 1e-6
"""Smallest weight of a state or input relative to the largest, so that the nearest rest is unique."""
SOLVED = 1e-6
"""Largest error of a solution of linear equations in half-widths."""
PENALTY = 1e6
"""Penalty on the rows, so that the QP is feasible even if no rest is inside."""

TargetStatus = Literal["reached", "nearest", "no rest"]
"""`nearest`: a rest whose outputs differ from r. `no rest`: none was found inside Z and V."""


@dataclass(frozen=True, eq=False)
class SteadyState:
    """A target in deviation coordinates. It is inside the plant's X and U for any status."""

    xu: np.ndarray
    """x_s, then u_s, (d + m,)."""
    status: TargetStatus
    distance: float
    """Largest distance of an output from r, as a share of its half-width."""
    outputs: tuple[int, ...]
    """Indices of the outputs, p."""
    r: np.ndarray
    """(p,)"""


class TargetSelector:
    """Finds targets of one problem for varying parameters theta of its oracle and varying references.

    Args:
        problem: provides model, oracle, cost, X and U.
        realise: turns a CasADi function into the function that is called.
    """

    def __init__(
        self,
        problem: Problem,
        realise: Callable[[ca.Function], ca.Function] = lambda function: function,
    ):
        model, plant = problem.model, problem.model.plant
        self._problem, self._realise = problem, realise
        self._scale = np.concatenate([plant.x_scale, plant.u_scale])
        weights = np.concatenate([np.diag(model.Q), np.diag(model.R)]) * self._scale**2
        self._weights = np.maximum(weights / weights.max(), LEAST)
        self._rows, self._lower, self._upper = _rows(problem, self._scale)
        ranges = row_ranges(self._rows, 1.0)
        self._penalty = Penalty(np.ones(len(self._rows), dtype=bool), ranges, PENALTY)
        low, high = np.concatenate([plant.x_min, plant.u_min]), np.concatenate([plant.x_max, plant.u_max])
        equilibrium = np.concatenate([plant.x_e, plant.u_e])
        self._low, self._high = (low - equilibrium) / self._scale, (high - equilibrium) / self._scale
        # Built at the first search, because a controller without a reference does not need it.
        self._function: Bound | None = None
        self._chosen: tuple[int, ...] | None = None
        self._per_weight = np.zeros(0)

    @property
    def _newton(self) -> Bound:
        if self._function is None:
            self._function = Bound(self._realise(self._build()))
        return self._function

    def _build(self) -> ca.Function:
        problem, size = self._problem, len(self._scale)
        w, theta = ca.MX.sym("w", size), ca.MX.sym("theta", problem.oracle.parameters)
        weights, wanted = ca.MX.sym("weights", size), ca.MX.sym("wanted", size)
        v = ca.MX.sym("v", problem.model.d)
        free, rests, wrong = newton_step(problem, self._scale, weights, wanted, w, theta, v)
        moved = ca.mmax(ca.fabs(free - w))
        values = ca.DM(self._rows) @ free
        outside = ca.mmax(ca.fmax(self._lower - values, values - self._upper) / self._penalty.scale)
        inside = ca.fmin(ca.fmax(free, self._low), self._high)
        said = ca.vertcat(wrong, moved, outside)
        found = {"free": free, "inside": inside, "rests": ca.densify(rests), "said": said}
        inputs = {"w": w, "theta": theta, "weights": weights, "wanted": wanted, "v": v}
        return ca.Function("newton", [*inputs.values()], [*found.values()], [*inputs], list(found))

    def find(
        self,
        theta: np.ndarray,
        start: np.ndarray,
        outputs: tuple[int, ...],
        r: np.ndarray,
        v: np.ndarray | float = 0.0,
    ) -> SteadyState:
        """Return the target for the oracle's parameters theta.

        The method never raises because of its numbers. If they cannot be used, the result is the equilibrium with the
        status `no rest`.

        Args:
            theta: the oracle's parameters.
            start: x and u of the last target, (d + m,).
            outputs: indices of the p output states. If there are more outputs than inputs, they match r in part.
            r: desired outputs, (p,), in deviations.
            v: motion of x at the target per period, (d,).
        """
        w, rests = start / self._scale, False
        chosen = list(outputs)
        wanted = r / self._scale[chosen]
        inputs = self._newton.inputs
        inputs["theta"][:, 0] = theta
        self._weigh(outputs)
        inputs["v"][:, 0] = v
        inputs["wanted"][:, 0] = 0.0
        inputs["wanted"][chosen, 0] = wanted
        for _ in range(STEPS):
            w, moved, outside = self._step(w)
            if not isfinite(moved):
                break
            if moved < ARRIVED:
                rests = outside <= INSIDE
                break
        distance = float(np.abs(w[chosen] - wanted).max(initial=0.0))
        status: TargetStatus = "no rest" if not rests else "reached" if distance < REACHED else "nearest"
        return SteadyState(w * self._scale, status, distance, outputs, r)

    def _weigh(self, outputs: tuple[int, ...]) -> None:
        """Set the weights of x and u for these outputs."""
        if outputs == self._chosen:
            return
        weights = self._weights.copy()
        if outputs:
            weights *= SECOND
            weights[list(outputs)] += 1.0
        self._newton.inputs["weights"][:, 0] = weights
        self._per_weight, self._chosen = 1.0 / np.sqrt(weights), outputs

    def _step(self, w: np.ndarray) -> tuple[np.ndarray, float, float]:
        """Take one Newton step from w, (d + m,), in half-widths.

        Returns:
            The result, clipped to the plant's X and U; the length of the step, infinite if the numbers are not usable;
            the distance from Z and V.
        """
        newton = self._newton
        newton.inputs["w"][:, 0] = w
        newton()
        wrong, moved, outside = newton.outputs["said"][:, 0].tolist()
        if not wrong <= SOLVED:
            return np.zeros_like(w), np.inf, np.inf
        if outside <= INSIDE:
            return newton.outputs["inside"][:, 0].copy(), moved, outside
        # free + moves q increases the cost by |q|^2 / 2 along the linearised rests.
        with np.errstate(all="ignore"):
            free, d = newton.outputs["free"][:, 0], len(newton.outputs["rests"])
            basis = np.linalg.qr((newton.outputs["rests"] * self._per_weight).T, mode="complete")[0][:, d:]
            moves = self._per_weight[:, None] * basis
            values, slopes = self._rows @ free, self._rows @ moves
            nearest = least_distance(values, slopes, self._lower, self._upper, self._penalty)
            if nearest is None:
                return np.zeros_like(w), np.inf, np.inf
            free = free + moves @ nearest.w
            outside = violation(nearest.values, self._lower, self._upper) / self._penalty.scale
        return np.clip(free, self._low, self._high), float(np.abs(free - w).max()), float(outside.max())


def newton_step(
    problem: Problem,
    scale: np.ndarray,
    weights: ca.MX,
    wanted: ca.MX,
    w: ca.MX,
    theta: ca.MX,
    v: ca.MX,
) -> tuple[ca.MX, ca.MX, ca.MX]:
    """Build one Newton step from w, (d + m,), in units of `scale`, (d + m,).

    Returns:
        w+, which minimises w'diag(weights) w / 2 - wanted'w on the rests of the model linearised at w; the Jacobian of
        these rests, (d, d + m); the residual of w+, NaN if it is no solution.
    """
    model, d = problem.model, problem.model.d
    linear = ca.DM(np.hstack([model.A - np.eye(d), model.B]))
    h, slopes = _h_at_rest(problem.oracle, w * scale, theta)
    motion = (linear @ (w * scale) + h - v) / scale[:d]
    rests = (linear + slopes) * (scale / scale[:d, None])
    matrix = ca.vertcat(ca.horzcat(ca.diag(weights), rests.T), ca.horzcat(rests, ca.DM.zeros(d, d)))
    matrix, right = ca.densify(matrix), ca.densify(ca.vertcat(wanted, rests @ w - motion))
    solution = ca.solve(matrix, right, "qr")
    # Use a sum of squares, because CasADi's maximum ignores NaN.
    wrong = ca.norm_2(matrix @ solution - right) / (1.0 + ca.norm_2(right))
    return solution[: len(scale)], rests, wrong


def _h_at_rest(oracle: Oracle, xu: ca.MX, theta: ca.MX) -> tuple[ca.MX, ca.MX]:
    """Return h_hat (d,) and its slopes (d, d + m) at (x, u), with all earlier pairs equal to (x, u)."""
    d, before = oracle.d, oracle.pairs - 1
    point, parts = ca.vertcat(xu[:d], *[xu] * before, xu[d:]), oracle.split(theta)
    (jacobian,) = oracle.jacobians(point, parts)
    slopes = ca.horzcat(jacobian[:, :d], jacobian[:, -oracle.m :])
    for i in range(before):
        slopes += jacobian[:, d + i * xu.shape[0] : d + (i + 1) * xu.shape[0]]
    return oracle.value(point, parts), slopes


def _rows(problem: Problem, scale: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the rows of the first and last step for (x, u) in units of `scale`, (rows, d + m), and their bounds.

    The steps between need no rows: a tube is thickest at the end, and any other tightening is plain X and U there.
    """
    first, last, inputs = problem.states[0], problem.states[-1], problem.inputs[-1]
    parts = [first] if last is first else [first, last]
    states = np.vstack([part.F for part in parts])
    m, d = inputs.dimension, first.dimension
    rows = np.vstack(
        [np.hstack([states, np.zeros((len(states), m))]), np.hstack([np.zeros((len(inputs.F), d)), inputs.F])]
    )
    parts = [*parts, inputs]
    return rows * scale, np.concatenate([p.lower for p in parts]), np.concatenate([p.upper for p in parts])
