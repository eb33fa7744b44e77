"""All constraint rows of a problem over (v, zbar) as one block: inputs, their changes, then states step by step.

The rows of inputs are hard, and kept exactly: each input in turn is clipped to its box and to what it can reach from
the one before. What acts is in U, so that there always is such an input. Where U has rows beside its box, an input that
breaks one is drawn to the equilibrium's, which is inside, and under rate limits all inputs move on the straight way
from the one before: U is convex, so both are kept.
"""

from __future__ import annotations

from copy import copy
from dataclasses import replace

import casadi as ca
import numpy as np

from lbmpc.casadi_buffers import Bound
from lbmpc.plants.rows import together
from lbmpc.problem import Problem
from lbmpc.sets.geometry.polytope import row_ranges
from lbmpc.solver.least_distance import (
    NO_ROWS,
    Nearest,
    Penalty,
    Shown,
    least_distance,
    violation,
)
from lbmpc.solver.priorities import Eased, contradicts, in_order

KEPT = 1e-7
"""A row that is off by less of its scale counts as kept: that much a QP's own tolerance may leave."""
Box = tuple[np.ndarray, np.ndarray]
"""Lower and upper bounds, (m,) each."""


class Rows:
    """The rows' bounds, their values, their slopes, what their violation costs, and the step that they allow."""

    def __init__(self, problem: Problem):
        n, m, d = problem.horizon, problem.model.m, problem.model.d
        self.n, self.m, self.d, self.soft = n, m, d, problem.soft
        plant = problem.model.plant
        self.input_rows = problem.inputs[0].F
        self.state_rows = problem.states[0].F
        common, of_stage = len(self.state_rows), len(self.input_rows)
        # U beside its box, about the equilibrium.
        self._beside = plant.input_rows.about(plant.u_e)
        last = problem.states[-1]
        # The last step may carry the rows of a terminal set behind the rows that all steps share.
        self.terminal_rows = last.F[common:]
        # Boxes throughout: the rows are the variables themselves.
        boxes = problem.states[0].is_box and problem.inputs[0].is_box
        self._plain = boxes and not len(self.terminal_rows)
        self._steps = problem.input_steps
        self._limited = bool(np.isfinite(self._steps).any())
        # Of all inputs, stage by stage, those with a row for the change from the one before. That of v_0 is a bound.
        self._changing = m + np.flatnonzero(np.tile(np.isfinite(self._steps), n - 1))
        change = np.tile(self._steps, n)[self._changing]
        self._together = self._limited and bool(self._beside.names)
        self._one_by_one = Bound(build_clip(n, self._steps)) if len(change) and not self._together else None
        self.lower = np.concatenate(
            [*(part.lower for part in problem.inputs), -change, *(part.lower for part in problem.states)]
        )
        self.upper = np.concatenate(
            [*(part.upper for part in problem.inputs), change, *(part.upper for part in problem.states)]
        )
        self.count_inputs = of_stage * n + len(change)
        # The same numbers as seen by inputs (N, m).
        self._lower_v, self._upper_v = (
            b[: of_stage * n].reshape(n, of_stage)[:, :m] for b in (self.lower, self.upper)
        )
        self._first = self.lower[:m].copy(), self.upper[:m].copy()
        self._before = np.zeros(m)
        # Of the plain sets' half-widths: tightening must not make a violation weigh more.
        of_inputs, of_states, of_terminal = (
            row_ranges(F, half)
            for F, half in (
                (self.input_rows, plant.u_scale),
                (self.state_rows, plant.x_scale),
                (self.terminal_rows, plant.x_scale),
            )
        )
        changes = np.tile(plant.u_scale, n)[self._changing]
        scale = np.concatenate([np.tile(of_inputs, n), changes, np.tile(of_states, n), of_terminal])
        soft = np.arange(len(self.lower)) >= self.count_inputs
        self.penalty = Penalty(soft, scale, problem.penalty)
        of_rows = [*([-1] * self.count_inputs), *([*problem.priorities] * n), *([0] * len(of_terminal))]
        self._levels = np.array(of_rows)
        self._in_order = max(problem.priorities) > 0
        self._last = replace(self.penalty, soft=self._levels == self._levels.max())
        # Since `bound_first`, where priorities contradicted each other.
        self._eased: Eased | None = None
        self._hard = replace(self.penalty, soft=np.zeros_like(soft))
        self.names = [
            f"{name} at step {i + 1}" for i, part in enumerate(problem.states) for name in part.names
        ]

    @property
    def first(self) -> Box:
        """The bounds on v_0 that are in force."""
        return self.lower[: self.m], self.upper[: self.m]

    def bound_first(self, first: Box | None, previous: np.ndarray | None) -> None:
        """Bounds on v_0 from now on.

        Args:
            first: taken into those of the problem; None: those of the problem.
            previous: what acts before v_0, (m,), from which rate limits count; None: the equilibrium's.
        """
        low, high = self._first
        self._eased = None
        if first is not None:
            low, high = np.clip(first[0], low, high), np.clip(first[1], low, high)
        if self._limited:
            before = np.clip(0.0 if previous is None else previous, *self._first)
            self._before = before = self._beside.pulled(before, 0.0)
            low, high = (np.clip(end, before - self._steps, before + self._steps) for end in (low, high))
        self.lower[: self.m], self.upper[: self.m] = low, high

    def clip(self, v: np.ndarray) -> np.ndarray:
        """Inputs (N, m) brought exactly inside their bounds; the QP keeps them to its tolerance only."""
        if self._one_by_one is None and not self._together:
            # np.clip takes twice as long for so few numbers.
            return self._beside.pulled(np.minimum(np.maximum(v, self._lower_v), self._upper_v), 0.0)
        return self.within_steps(v)

    def within_steps(self, v: np.ndarray) -> np.ndarray:
        """The same, for what keeps the box of U: all of U, and the rate limits; as it is where there are none."""
        if self._together:
            return self._straight(v)
        if self._one_by_one is None:
            return self._beside.pulled(v, 0.0)
        inputs = self._one_by_one.inputs
        inputs["v"][:], inputs["lower"][:], inputs["upper"][:] = v.T, self._lower_v.T, self._upper_v.T
        self._one_by_one()
        return self._one_by_one.outputs["clipped"].T.copy()

    def _straight(self, v: np.ndarray) -> np.ndarray:
        """Inputs (N, m) of all of U, each on the straight way from the one before it."""
        inside = self._beside.pulled(np.clip(v, *self._first), 0.0)
        kept, before, (low, high) = np.empty_like(v), self._before, self.first
        for i, u in enumerate(inside):
            kept[i] = before = together(u, before, low, high)
            low, high = before - self._steps, before + self._steps
        return kept

    def values(self, v: np.ndarray, zbar: np.ndarray) -> np.ndarray:
        """Row values of inputs v (m, n) and nominal states zbar (d, n)."""
        return self.apply(np.concatenate([v.T.ravel(), zbar.T.ravel()]))

    def apply(self, y: np.ndarray) -> np.ndarray:
        """The rows of y = (v_0..n-1, zbar_1..n), stage by stage: ((m + d) n,) -> (rows,), or for many columns."""
        n, split, later = self.n, self.m * self.n, self._changing
        if self._plain:
            return np.concatenate([y[:split], y[later] - y[later - self.m], y[split:]]) if len(later) else y
        many = y.reshape(len(y), -1)
        inputs = np.matmul(self.input_rows, many[:split].reshape(n, self.m, -1))
        states = np.matmul(self.state_rows, many[split:].reshape(n, self.d, -1))
        k = many.shape[1]
        last = self.terminal_rows @ many[len(y) - self.d :]
        blocks = [inputs.reshape(-1, k), many[later] - many[later - self.m], states.reshape(-1, k), last]
        return np.concatenate(blocks).reshape(-1, *y.shape[1:])

    def kept(self, values: np.ndarray) -> bool:
        """Whether values (rows,) are inside their bounds."""
        return bool(((values <= self.upper) & (values >= self.lower)).all())

    def price(self, values: np.ndarray) -> float:
        """What it costs that values (rows,) are outside their bounds, were every state row soft.

        What had to be granted for the sake of an order costs nothing.
        """
        return self.penalty.cost(violation(values, *(self._eased or (self.lower, self.upper))))

    def nearest(
        self, values: np.ndarray, slopes: np.ndarray, hint: np.ndarray = NO_ROWS, ready: Shown | None = None
    ) -> tuple[Nearest | None, bool]:
        """The w nearest to 0 that the rows allow, and whether the hard state rows can be met.

        Softly where state rows are soft or contradict each other; None where the numbers are unusable. Arguments as for
        `least_distance`.
        """
        if self._eased is None:
            first = self.penalty if self.soft else self._hard
            nearest = least_distance(values, slopes, self.lower, self.upper, first, hint, ready)
            feasible = self.soft or nearest is not None
            if not feasible:
                nearest = least_distance(values, slopes, self.lower, self.upper, self.penalty, hint)
            if nearest is None or not self._in_order or not self._contradicts(nearest):
                return nearest, feasible
            ordered = in_order(values, slopes, self.lower, self.upper, self.penalty, self._levels)
            if ordered is None:
                return nearest, feasible
            self._eased = ordered[1]
            return ordered[0], feasible
        # What was granted stays, so that the cost is comparable from step to step.
        return least_distance(values, slopes, *self._eased, self._last, hint), self.soft

    def fresh(self) -> Rows:
        """The same rows, to be given other bounds; those of v_0 are in force."""
        rows = copy(self)
        rows._eased = None
        return rows

    @property
    def ordered(self) -> bool:
        """Whether priorities contradicted each other since `bound_first`."""
        return self._eased is not None

    def _contradicts(self, nearest: Nearest) -> bool:
        return contradicts(nearest.values, self.lower, self.upper, self.penalty.scale, self._levels)

    def slack(self, outside: np.ndarray) -> tuple[float, str]:
        """The largest violation of a state row, in shares, and the row's name, from all rows' violations, (rows,)."""
        states = (outside / self.penalty.scale)[self.count_inputs :]
        worst = int(states.argmax())
        slack = float(states[worst])
        return (slack, self.names[worst]) if slack > KEPT else (0.0, "")


def build_clip(n: int, steps: np.ndarray) -> ca.Function:
    """(v, lower, upper) -> clipped, (m, n) each: each input in its bounds and within `steps`, (m,), of the one before.

    The first is within its bounds alone.
    """
    m = len(steps)
    v, lower, upper = (ca.SX.sym(name, m, n) for name in ("v", "lower", "upper"))
    clipped = [ca.fmin(ca.fmax(v[:, 0], lower[:, 0]), upper[:, 0])]
    for i in range(1, n):
        before = clipped[-1]
        low, high = ca.fmax(lower[:, i], before - steps), ca.fmin(upper[:, i], before + steps)
        clipped.append(ca.fmin(ca.fmax(v[:, i], low), high))
    names = ["v", "lower", "upper"]
    return ca.Function("clip", [v, lower, upper], [ca.densify(ca.horzcat(*clipped))], names, ["clipped"])
