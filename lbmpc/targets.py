"""The rest that a plan aims at: the target selector of offset-free MPC, with what was learned.

    min over x, u   |C x - r|^2 + SECOND (|x|_Q^2 + |u|_R^2)
    subject to      (A - I) x + B u + h_hat(x, u) = v,   x in Z,   u in V

in deviation coordinates, everything in half-widths. Q and R are those of the cost, Z and V the tightened X and U of the
problem. So the outputs C x come first: they meet r where the learned model has such a rest, and are as near as they can
be where it has none. Of all rests that do as well the target costs least about the equilibrium, and without outputs it
costs least of all rests (Muske and Rawlings 1993; Pannocchia and Rawlings 2003). v is 0, but on the way of a reference
that moves: there it is how far the rest moves in a period, so that a plant at the target moves on with it.

A few Newton steps from the last target solve it, always as many at most, and never by the clock. Each is an equality
constrained least-squares problem; where its solution is outside the rows, a QP with as many variables as inputs.
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
"""Newton steps in one search at most. The next search goes on from where this one ends."""
ARRIVED = 1e-5
"""Half-widths: a step that is shorter leaves an error of its square."""
INSIDE = 1e-6
"""Of a row's range: how far outside Z or V a rest may be, as far as a QP's tolerance lets it."""
REACHED = 1e-4
"""Half-widths: outputs that are so near to r count as there."""
SECOND = 1e-8
"""Weight of the cost beside that of the outputs: small enough to move them by less than anybody sees."""
LEAST = 1e-6
"""Of the largest weight: what a state or input counts at least, so that there is one nearest rest."""
SOLVED = 1e-6
"""What linear equations in half-widths may be off by; more, and they have no solution."""
PENALTY = 1e6
"""Of the rows, so that there is a solution of the QP where no rest is inside."""

TargetStatus = Literal["reached", "nearest", "no rest"]
"""nearest: a rest, but not where the outputs are at r; no rest: none was found inside Z and V."""


@dataclass(frozen=True, eq=False)
class SteadyState:
    """A target, in deviation coordinates, inside the plant's X and U whatever its status."""

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
    """Finds targets of one problem, for one parameter theta of its oracle and one reference after another.

    Args:
        problem: its model, oracle, cost, X and U.
        realise: what turns a CasADi function into the one that is called.
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
        # Built at the first search: a controller without a reference does not need it.
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
        """The target under the oracle's parameters theta.

        Never raises for numbers; where they cannot be used it is the equilibrium, with the status `no rest`.

        Args:
            theta: the oracle's.
            start: x and u of the last target, (d + m,).
            outputs: indices of the states that are outputs, p; more than there are inputs meet their r in part.
            r: where they should be, (p,), deviations.
            v: how far x moves there in a period, (d,).
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
        """Weights of x and u for these outputs."""
        if outputs == self._chosen:
            return
        weights = self._weights.copy()
        if outputs:
            weights *= SECOND
            weights[list(outputs)] += 1.0
        self._newton.inputs["weights"][:, 0] = weights
        self._per_weight, self._chosen = 1.0 / np.sqrt(weights), outputs

    def _step(self, w: np.ndarray) -> tuple[np.ndarray, float, float]:
        """One Newton step from w, (d + m,), in half-widths.

        Returns:
            Where it leads, inside the plant's X and U; how far that is, infinite where the numbers are unusable; how
            far from Z and V that is.
        """
        newton = self._newton
        newton.inputs["w"][:, 0] = w
        newton()
        wrong, moved, outside = newton.outputs["said"][:, 0].tolist()
        if not wrong <= SOLVED:
            return np.zeros_like(w), np.inf, np.inf
        if outside <= INSIDE:
            return newton.outputs["inside"][:, 0].copy(), moved, outside
        # free + moves q costs |q|^2 / 2 more, along the rests as they are linearised.
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
    """One Newton step from w, (d + m,), in units of `scale`, (d + m,).

    Returns:
        w+, which minimises w'diag(weights) w / 2 - wanted'w on the rests of the model linearised at w; the Jacobian of
        these rests, (d, d + m); how far w+ is from a solution, NaN where it is none.
    """
    model, d = problem.model, problem.model.d
    linear = ca.DM(np.hstack([model.A - np.eye(d), model.B]))
    h, slopes = _h_at_rest(problem.oracle, w * scale, theta)
    motion = (linear @ (w * scale) + h - v) / scale[:d]
    rests = (linear + slopes) * (scale / scale[:d, None])
    matrix = ca.vertcat(ca.horzcat(ca.diag(weights), rests.T), ca.horzcat(rests, ca.DM.zeros(d, d)))
    matrix, right = ca.densify(matrix), ca.densify(ca.vertcat(wanted, rests @ w - motion))
    solution = ca.solve(matrix, right, "qr")
    # A sum of squares, since a largest one of CasADi overlooks what is no number.
    wrong = ca.norm_2(matrix @ solution - right) / (1.0 + ca.norm_2(right))
    return solution[: len(scale)], rests, wrong


def _h_at_rest(oracle: Oracle, xu: ca.MX, theta: ca.MX) -> tuple[ca.MX, ca.MX]:
    """h_hat (d,) and its slopes (d, d + m) at (x, u) where that was the pair before as well, and all before it."""
    d, before = oracle.d, oracle.pairs - 1
    point, parts = ca.vertcat(xu[:d], *[xu] * before, xu[d:]), oracle.split(theta)
    (jacobian,) = oracle.jacobians(point, parts)
    slopes = ca.horzcat(jacobian[:, :d], jacobian[:, -oracle.m :])
    for i in range(before):
        slopes += jacobian[:, d + i * xu.shape[0] : d + (i + 1) * xu.shape[0]]
    return oracle.value(point, parts), slopes


def _rows(problem: Problem, scale: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows of (x, u) in units of `scale`, (rows, d + m), and their bounds: the first step's, and the last one's.

    Of the steps between, a tightening to a tube is no thicker than at the end, and any other is plain X and U.
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
