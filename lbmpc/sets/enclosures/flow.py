"""Validated integration: enclosures of a plant's flow over one period, and of its derivative, for boxes of x and u.

Each step has three parts (Nedialkov, Jackson and Corliss 1999). A box E that no trajectory leaves during the step is
guessed and *proved* by one inclusion. The Taylor coefficients over the starting set give the polynomial, and the one
over E gives the remainder. The sets are then propagated in mean-value form,

    Phi_t(p) in Phi_t(c) + D_t (p - c),    D_t an enclosure of dPhi_t/dp over the whole initial box p = (x, u),

with dPhi/dp from the variational equation S' = f_x S + [0, f_u]. This avoids wrapping the box again in every step.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca
import numpy as np

from lbmpc.plants.description import Description
from lbmpc.plants.equations import Plant
from lbmpc.sets.enclosures.expression_graph import Graph, Node
from lbmpc.sets.enclosures.interval import DomainError, Interval, matrix_product
from lbmpc.sets.enclosures.series import Tape

ORDERS = 16
# Norm of f_x times a step. 1.5^16 / 16! = 3e-11, and E reduces the rest to rounding.
STEP_NORM = 1.2
ATTEMPTS = 4
DOUBLINGS = 3
# A step is halved if its remainder is wider than this, relative to the state and to the image of the box.
ROUGH, ROUGH_OF_BOX = 1e-11, 1e-6


SMALLER = "Use a smaller region of x and u, or a shorter period"
DOMAINS = {
    "sqrt": "its argument must stay above 0",
    "log": "its argument must stay above 0",
    "a division": "its divisor must not reach 0",
}


def name_of(plant: Description, leaf: Node) -> str:
    """Return the plant's name of a state or an input of its equations."""
    return (plant.states if leaf.operation == "state" else plant.inputs)[leaf.index]


class NoEnclosure(ArithmeticError):
    """No box was proved to contain the trajectories of a step, for the boxes of the mask `where`."""

    def __init__(self, where: np.ndarray):
        super().__init__("no box could be proved to contain all trajectories")
        self.where = where


@dataclass(frozen=True, eq=False)
class FlowEnclosure:
    """The images of boxes after one period; n boxes, d states, q = d + m coordinates of p = (x, u)."""

    end: Interval
    """(n, d), contains Phi(p) for every p of the box."""
    centre: Interval
    """(n, d), contains Phi(c)."""
    derivative: Interval
    """(n, d, q), contains dPhi/dp for every p of the box."""
    trouble: tuple[str, ...]
    """(n,), the reason why there is no proof, with invalid numbers; empty for a proved enclosure."""

    @property
    def proved(self) -> np.ndarray:
        return np.array([not t for t in self.trouble], dtype=bool)


class Flow:
    """Phi_T(x, u) of dx/dt = f(x, u) with u constant over the period T (seconds)."""

    def __init__(
        self,
        function: ca.Function,
        period: float,
        steps: int = 1,
        orders: int = ORDERS,
        name_of: Callable[[Node], str] = lambda node: f"{node.operation} {node.index}",
    ):
        """`name_of` returns the name of a state or an input for messages."""
        self.d, self.m = function.numel_in(0), function.numel_in(1)
        self.period, self.steps, self.orders = period, steps, orders
        self._name_of = name_of
        graph = Graph()
        outputs = graph.read(function)
        self._plain = Tape(graph, outputs)
        self._pattern, variations = self._variational(graph, outputs)
        self._whole = Tape(graph, outputs + variations)

    @classmethod
    def of_plant(cls, plant: Plant, period: float) -> Flow:
        """Build the flow with as many steps as the plant's linearisation requires."""
        f = plant.function()
        x, u = ca.SX.sym("x", plant.d), ca.SX.sym("u", plant.m)
        slope = np.abs(
            np.array(ca.Function("slope", [x, u], [ca.jacobian(f(x, u), x)])(plant.x_e, plant.u_e))
        )
        norm = float(np.abs(np.linalg.eigvals(slope)).max())
        return cls(
            f, period, max(1, math.ceil(norm * period / STEP_NORM)), name_of=lambda node: name_of(plant, node)
        )

    @property
    def q(self) -> int:
        return self.d + self.m

    def _variational(self, graph: Graph, outputs: list[int]) -> tuple[list[tuple[int, int]], list[int]]:
        """Return the structurally nonzero S_ij, and the nodes of dS_ij/dt, with S_ij as states d, d + 1, ..."""
        d, q = self.d, self.q
        slopes = [
            [graph.derivative(f, graph.state(j) if j < d else graph.input(j - d)) for j in range(q)]
            for f in outputs
        ]
        present = np.zeros((d, q), dtype=bool)
        present[:, :d] = np.eye(d, dtype=bool)
        edges = np.array([[slope is not None for slope in row] for row in slopes], dtype=bool).reshape(d, q)
        for _ in range(d + 1):
            grown = present | (edges[:, :d].astype(int) @ present.astype(int) > 0)
            grown[:, d:] |= edges[:, d:]
            present = grown
        pattern = [(i, j) for i in range(d) for j in range(q) if present[i, j]]
        index = {pair: d + n for n, pair in enumerate(pattern)}
        rates = []
        for i, j in pattern:
            terms: list[int | None] = [slopes[i][j]] if j >= d else []
            for k in range(d):
                slope = slopes[i][k]
                if slope is not None and (k, j) in index:
                    terms.append(graph.times(slope, graph.state(index[k, j])))
            total = graph.total(terms)
            rates.append(graph.constant(0.0) if total is None else total)
        return pattern, rates

    def enclose(
        self, x: Interval, u: Interval, x_centre: Interval, u_centre: Interval, radii: np.ndarray
    ) -> FlowEnclosure:
        """Enclose the flow of n boxes x (n, d) and u (n, m) about inner points, given as (almost) point intervals.

        radii (n, q): |p - c| of every p of the box, rounded up.
        """
        n = x.shape[0]
        trouble = [""] * n
        nothing = np.full((n, self.d), np.nan), np.full((n, self.d, self.q), np.nan)
        end, centre, slope = (Interval(a.copy(), a.copy()) for a in (nothing[0], nothing[0], nothing[1]))
        waiting, proved = np.arange(n), np.zeros(n, dtype=bool)
        for doubling in range(DOUBLINGS + 1):
            left: list[int] = []
            while waiting.size:
                try:
                    result = self._integrate(
                        x[waiting],
                        u[waiting],
                        x_centre[waiting],
                        u_centre[waiting],
                        radii[waiting],
                        self.steps * 2**doubling,
                    )
                except (DomainError, NoEnclosure) as error:
                    for i in waiting[error.where & ~proved[waiting]]:
                        trouble[i] = self._trouble(error)
                    left.extend(waiting[error.where])
                    waiting = waiting[~error.where]
                    continue
                for target, value in zip((end, centre, slope), result, strict=True):
                    target.lower[waiting], target.upper[waiting] = value.lower, value.upper
                for i in waiting:
                    trouble[i] = ""
                proved[waiting] = True
                left.extend(waiting[_rough(result[0], result[1])])
                break
            waiting = np.array(sorted(left), dtype=int)
        return FlowEnclosure(end, centre, slope, tuple(trouble))

    def _trouble(self, error: DomainError | NoEnclosure) -> str:
        """Return the operation that failed, its variables and a remedy."""
        if isinstance(error, NoEnclosure):
            return f"{error}. {SMALLER}"
        names = " and ".join(self._name_of(leaf) for leaf in error.leaves)
        return (
            f"{error.operation} of an expression in {names or 'constants'} leaves its domain of definition and "
            f"smoothness ({DOMAINS[error.operation]}). Give {names or 'the plant'} bounds that keep inside "
            "this domain during the whole period, use a smaller region, or give W yourself (--kind given)"
        )

    def _integrate(
        self, x: Interval, u: Interval, xc: Interval, uc: Interval, radii: np.ndarray, steps: int
    ) -> tuple[Interval, Interval, Interval]:
        n, d, q = x.shape[0], self.d, self.q
        # The step is an interval, because a period divided by the number of steps is rarely a float.
        width = Interval.of(self.period) / float(steps)
        identity = np.broadcast_to(np.hstack([np.eye(d), np.zeros((d, q - d))]), (n, d, q))
        slope = Interval.of(identity)
        us = [u[:, j] for j in range(self.m)]
        ucs = [uc[:, j] for j in range(self.m)]
        ball = Interval(-radii, radii)[..., None]
        with np.errstate(over="ignore", invalid="ignore", under="ignore"):
            for _ in range(steps):
                x_next, local, remainder = self._step(x, us, width)
                xc = self._advance_centre(xc, ucs, width, remainder)
                slope = _chain(local, slope, d)
                spread = matrix_product(slope, ball)[..., 0]
                x = x_next.meet(xc + spread)
        return x, xc, slope

    def _step(self, x: Interval, us: list[Interval], width: Interval) -> tuple[Interval, Interval, Interval]:
        """Return x after the step (n, d), its derivative by the initial state and input (n, d, q), remainder (d, n)."""
        n, d, q = x.shape[0], self.d, self.q
        one, zero = Interval.of(np.ones(n)), Interval.of(np.zeros(n))
        start = [x[:, i] for i in range(d)] + [one if i == j else zero for i, j in self._pattern]
        series = self._whole.series(start, us, width, self.orders - 1)
        total = series.coefficient(0)
        path = total
        for k in range(1, self.orders):
            term = series.coefficient(k)
            path = path + Interval(np.minimum(term.lower, 0.0), np.maximum(term.upper, 0.0))
        guess = 2.0 * term.magnitude() + 1e-13 * path.magnitude() + 1e-30
        for _ in range(ATTEMPTS):
            box = path + Interval(-guess, guess)
            last = self._whole.series([box[i] for i in range(len(start))], us, width, self.orders)
            remainder = last.coefficient(self.orders)
            reached = path + Interval(np.minimum(remainder.lower, 0.0), np.maximum(remainder.upper, 0.0))
            # Strictly inside proves the box: suppose that a trajectory first reaches the boundary of the box. It was in
            # the box until then, so Taylor's formula puts it into `reached`, which does not touch the boundary.
            inside = (reached.lower > box.lower) & (reached.upper < box.upper)
            if inside.all():
                break
            guess = np.where(inside, guess, 4.0 * remainder.magnitude() + 1e-12 * path.magnitude())
        else:
            raise NoEnclosure(np.asarray(~inside.all(axis=0)))
        end = series.total(remainder)
        local = np.zeros((2, n, d, q))
        for row, (i, j) in enumerate(self._pattern):
            local[0, :, i, j], local[1, :, i, j] = end.lower[d + row], end.upper[d + row]
        return Interval(end.lower[:d].T, end.upper[:d].T), Interval(local[0], local[1]), remainder[:d]

    def _advance_centre(
        self, xc: Interval, ucs: list[Interval], width: Interval, remainder: Interval
    ) -> Interval:
        series = self._plain.series([xc[:, i] for i in range(self.d)], ucs, width, self.orders - 1)
        end = series.total(remainder)
        return Interval(end.lower.T, end.upper.T)


def _rough(end: Interval, centre: Interval) -> np.ndarray:
    """Return the boxes, (n,), whose remainder exceeds rounding and a small share of the box's image."""
    width = centre.upper - centre.lower
    small = ROUGH * (1.0 + centre.magnitude()) + ROUGH_OF_BOX * (end.upper - end.lower)
    return np.asarray((width > small).any(axis=1))


def _chain(local: Interval, slope: Interval, d: int) -> Interval:
    """Return d(after)/dp from the derivative of the step (n, d, q) and d(before)/dp (n, d, q)."""
    q = slope.shape[-1]
    result = matrix_product(local[:, :, :d], slope)
    return Interval(
        np.concatenate([result.lower[..., :d], (result + local).lower[..., d:]], axis=-1)[..., :q],
        np.concatenate([result.upper[..., :d], (result + local).upper[..., d:]], axis=-1)[..., :q],
    )
