"""All constraint rows of a problem over (v, zbar) as one block: inputs, their changes, then states step by step.

Input rows are hard and satisfied exactly. Each input in turn is clipped to its box and to its reachable range from the
previous one. The present input is in U, so such an input always exists. If U has rows besides its box, an input that
violates one is moved towards the equilibrium input, which is inside. Under rate limits all inputs then move along the
line from the previous input. U is convex, so both kinds of rows hold.
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
"""Share of a row's scale. A smaller violation counts as satisfied, because a QP has a tolerance."""
Box = tuple[np.ndarray, np.ndarray]
"""Lower and upper bounds, (m,) each."""


class Rows:
    """Bounds, values and slopes of the rows, the cost of violations, and the nearest feasible step."""

    def __init__(self, problem: Problem):
        n, m, d = problem.horizon, problem.model.m, problem.model.d
        self.n, self.m, self.d, self.soft = n, m, d, problem.soft
        plant = problem.model.plant
        self.input_rows = problem.inputs[0].F
        self.state_rows = problem.states[0].F
        common, of_stage = len(self.state_rows), len(self.input_rows)
        # The rows of U besides its box, in deviations from the equilibrium.
        self._beside = plant.input_rows.about(plant.u_e)
        last = problem.states[-1]
        # The last step can have the rows of a terminal set in addition to the common rows.
        self.terminal_rows = last.F[common:]
        # With boxes only, the rows are the variables themselves.
        boxes = problem.states[0].is_box and problem.inputs[0].is_box
        self._plain = boxes and not len(self.terminal_rows)
        self._steps = problem.input_steps
        self._limited = bool(np.isfinite(self._steps).any())
        # Indices of inputs with a row for the change from the previous stage. The change of v_0 is a bound instead.
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
        # Views of the same numbers for inputs (N, m).
        self._lower_v, self._upper_v = (
            b[: of_stage * n].reshape(n, of_stage)[:, :m] for b in (self.lower, self.upper)
        )
        self._first = self.lower[:m].copy(), self.upper[:m].copy()
        self._before = np.zeros(m)
        # Ranges of the sets before tightening, so that tightening does not increase the weight of a violation.
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
        # Bounds with relaxations, once priorities have conflicted since `bound_first`.
        self._eased: Eased | None = None
        self._hard = replace(self.penalty, soft=np.zeros_like(soft))
        self.names = [
            f"{name} at step {i + 1}" for i, part in enumerate(problem.states) for name in part.names
        ]

    @property
    def first(self) -> Box:
        """The bounds on v_0 in force."""
        return self.lower[: self.m], self.upper[: self.m]

    def bound_first(self, first: Box | None, previous: np.ndarray | None) -> None:
        """Set the bounds on v_0.

        Args:
            first: additional bounds; None for those of the problem alone.
            previous: the input before v_0, (m,), as start of rate limits; None for the equilibrium's.
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
        """Return inputs (N, m) clipped exactly to their bounds. The QP satisfies them up to its tolerance only."""
        if self._one_by_one is None and not self._together:
            # np.clip takes twice as long on such small arrays.
            return self._beside.pulled(np.minimum(np.maximum(v, self._lower_v), self._upper_v), 0.0)
        return self.within_steps(v)

    def within_steps(self, v: np.ndarray) -> np.ndarray:
        """Apply the rows of U and the rate limits to inputs that already are in the box of U."""
        if self._together:
            return self._straight(v)
        if self._one_by_one is None:
            return self._beside.pulled(v, 0.0)
        inputs = self._one_by_one.inputs
        inputs["v"][:], inputs["lower"][:], inputs["upper"][:] = v.T, self._lower_v.T, self._upper_v.T
        self._one_by_one()
        return self._one_by_one.outputs["clipped"].T.copy()

    def _straight(self, v: np.ndarray) -> np.ndarray:
        """Return inputs (N, m) in U, each on the line from the previous one."""
        inside = self._beside.pulled(np.clip(v, *self._first), 0.0)
        kept, before, (low, high) = np.empty_like(v), self._before, self.first
        for i, u in enumerate(inside):
            kept[i] = before = together(u, before, low, high)
            low, high = before - self._steps, before + self._steps
        return kept

    def values(self, v: np.ndarray, zbar: np.ndarray) -> np.ndarray:
        """Return the row values of inputs v (m, n) and nominal states zbar (d, n)."""
        return self.apply(np.concatenate([v.T.ravel(), zbar.T.ravel()]))

    def apply(self, y: np.ndarray) -> np.ndarray:
        """Apply the rows to y = (v_0..n-1, zbar_1..n), stage by stage: ((m + d) n,) -> (rows,), or to many columns."""
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
        """Return whether values (rows,) are within their bounds."""
        return bool(((values <= self.upper) & (values >= self.lower)).all())

    def price(self, values: np.ndarray) -> float:
        """Return the cost of the violations of values (rows,), with every state row taken as soft.

        Violations granted to rows by the order of priorities cost nothing.
        """
        return self.penalty.cost(violation(values, *(self._eased or (self.lower, self.upper))))

    def nearest(
        self, values: np.ndarray, slopes: np.ndarray, hint: np.ndarray = NO_ROWS, ready: Shown | None = None
    ) -> tuple[Nearest | None, bool]:
        """Return the w nearest to 0 that satisfies the rows, and whether the hard state rows are feasible.

        State rows are relaxed if they are soft or conflict. The first result is None if the numbers are not finite.
        Arguments as for `least_distance`.
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
        # Granted relaxations are kept, so that costs remain comparable from step to step.
        return least_distance(values, slopes, *self._eased, self._last, hint), self.soft

    def fresh(self) -> Rows:
        """Return a copy of the rows to be given other bounds; the bounds on v_0 are kept."""
        rows = copy(self)
        rows._eased = None
        return rows

    @property
    def ordered(self) -> bool:
        """Whether priorities have conflicted since `bound_first`."""
        return self._eased is not None

    def _contradicts(self, nearest: Nearest) -> bool:
        return contradicts(nearest.values, self.lower, self.upper, self.penalty.scale, self._levels)

    def slack(self, outside: np.ndarray) -> tuple[float, str]:
        """Return the largest relative violation of a state row and its name, given those of all rows, (rows,)."""
        states = (outside / self.penalty.scale)[self.count_inputs :]
        worst = int(states.argmax())
        slack = float(states[worst])
        return (slack, self.names[worst]) if slack > KEPT else (0.0, "")


def build_clip(n: int, steps: np.ndarray) -> ca.Function:
    """Build (v, lower, upper) -> clipped, (m, n) each: inputs within bounds and within `steps`, (m,), of the last one.

    The first input is only clipped to its bounds.
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
