"""Taylor series in time of expressions along a flow, with balls as coefficients.

`Tape` runs the operations of a graph order by order for a batch of boxes: from operands known to order k it computes
the results to order k. Time is in units of the step, so coefficient k contains the k-th power of the step.

Order 0 is an interval operation and tight. Higher orders use balls, middle +- radius. A Taylor recurrence consists of
sums of products, for which balls need three plain products, and intervals four products and their extrema. The loss is
of third order in the size of the box.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lbmpc.sets.enclosures.expression_graph import CONJUGATE, Graph, Node, leaves
from lbmpc.sets.enclosures.interval import DomainError, Interval

# The error of a sum of up to 40 products of floats, in any order, is below 41 * 2^-53 = 4.6e-15 of the sum of their
# magnitudes (Higham, Accuracy and Stability, 3.1). DOT is twice that, to cover the arithmetic of the bound itself. TINY
# is far above the loss of 40 products by underflow.
MOST_ORDERS = 40
DOT = 1e-14
ULP = 2.3e-16
TINY = 1e-300


class Tape:
    """The series of dx/dt = outputs(x, u) for constant u, over a batch of boxes of x and u."""

    def __init__(self, graph: Graph, outputs: Sequence[int]):
        self.nodes = list(graph.nodes)
        self.outputs = list(outputs)
        self._where = {node: i for i, node in enumerate(self.nodes)}
        self.needed = self._reach()
        self.fixed = self._fixed_in_time()
        # States that no equation uses also have a series.
        self.states = {node.index: i for i, node in enumerate(self.nodes) if node.operation == "state"}

    def partners(self, i: int) -> tuple[int, ...]:
        """Return the nodes whose series node i needs: its operands, and for some nodes a related function."""
        node = self.nodes[i]
        if node.operation in CONJUGATE:
            return (*node.operands, self._where[Node(CONJUGATE[node.operation], node.operands)])
        if node.operation == "tanh":
            return (*node.operands, self._where[Node("power", (i, i), number=2.0)])
        return node.operands

    def _reach(self) -> list[int]:
        needed: set[int] = set()
        pending = list(self.outputs)
        while pending:
            i = pending.pop()
            if i not in needed:
                needed.add(i)
                pending.extend(self.partners(i))
        return sorted(needed)

    def _fixed_in_time(self) -> list[bool]:
        fixed: list[bool] = []
        for node in self.nodes:
            fixed.append(node.operation != "state" and all(fixed[j] for j in node.operands))
        return fixed

    def series(
        self, x: Sequence[Interval], u: Sequence[Interval], step: Interval, orders: int
    ) -> Coefficients:
        """Return coefficients 0..`orders` of every state; x[i] and u[j] have shape (batch,); time in `step` seconds.

        Raises:
            DomainError: a root, logarithm or division leaves its domain in some boxes.
        """
        return Coefficients(self, x, u, step, orders)


class Coefficients:
    """Taylor coefficients of all nodes of a tape, for one batch of boxes."""

    def __init__(self, tape: Tape, x: Sequence[Interval], u: Sequence[Interval], step: Interval, orders: int):
        if orders > MOST_ORDERS - 2:
            raise ValueError(
                f"{orders} orders requested; the bounds on rounding hold for at most {MOST_ORDERS - 2}"
            )
        self.tape, self.orders = tape, orders
        batch = x[0].shape[0]
        d = len(x)
        count = len(tape.nodes)
        self._first: dict[int, Interval] = {}
        # Nodes come first, then states. A state that an equation uses shares the rows of its node.
        rows = count + d
        self._m = np.zeros((rows, orders + 1, batch))
        self._r = np.zeros((rows, orders + 1, batch))
        self._abs = np.zeros((rows, orders + 1, batch))
        self._mag = np.zeros((rows, orders + 1, batch))
        self._reach = np.zeros((rows, orders + 1, batch))
        self._state = [tape.states.get(i, count + i) for i in range(d)]
        self._batch = batch
        self._start(x, u)
        for k in range(orders):
            if k:
                for i in tape.needed:
                    if not tape.fixed[i]:
                        self._advance(i, k)
            factor = step / float(k + 1)
            fm, fr = float(factor.middle()), float(factor.radius())
            for i, output in enumerate(tape.outputs):
                m, r = self._scale(output, k, fm, fr)
                self._store(self._state[i], k + 1, m, r)

    def coefficient(self, k: int) -> Interval:
        """Return the k-th coefficient of every state, (states, batch)."""
        m, r = self._m[self._state, k], self._r[self._state, k]
        return Interval(np.nextafter(m - r, -np.inf), np.nextafter(m + r, np.inf))

    def total(self, remainder: Interval) -> Interval:
        """Return the states after one step: all coefficients plus a remainder (states, batch)."""
        result = remainder
        for k in range(self.orders, -1, -1):
            result = result + self.coefficient(k)
        return result

    def _start(self, x: Sequence[Interval], u: Sequence[Interval]) -> None:
        for i in self.tape.needed:
            node = self.tape.nodes[i]
            try:
                self._first[i] = self._zeroth(node, x, u)
            except DomainError as error:
                raise DomainError(
                    error.operation, error.where, leaves(self.tape.nodes, node.operands[-1:])
                ) from error
            self._store_interval(i, self._first[i])
        for i, value in enumerate(x):
            self._store_interval(self._state[i], value)

    def _zeroth(self, node: Node, x: Sequence[Interval], u: Sequence[Interval]) -> Interval:
        if node.operation == "state":
            return x[node.index]
        if node.operation == "input":
            return u[node.index]
        if node.operation == "constant":
            return Interval.of(np.full(self._batch, node.number))
        a, b = self._first[node.operands[0]], self._first[node.operands[-1]]
        match node.operation:
            case "add":
                return a + b
            case "sub":
                return a - b
            case "mul":
                return a * b
            case "div":
                return a / b
            case "power":
                return a.power(int(node.number))
            case "neg":
                return -a
        return getattr(a, node.operation)()

    def _store_interval(self, i: int, value: Interval) -> None:
        m = value.middle()
        self._store(i, 0, m, value.radius(m))

    def _store(self, i: int, k: int, m: np.ndarray, r: np.ndarray) -> None:
        size = np.abs(m)
        self._m[i, k], self._r[i, k], self._abs[i, k] = m, r, size
        self._mag[i, k] = size + r
        # The radius of the second factor includes the rounding of a sum of products.
        self._reach[i, k] = r + DOT * size

    def _scale(self, i: int, k: int, factor: float, radius: float) -> tuple[np.ndarray, np.ndarray]:
        m = self._m[i, k] * factor
        r = self._r[i, k] * abs(factor) + self._mag[i, k] * radius
        return m, (r + ULP * np.abs(m)) * (1 + DOT) + TINY

    def _convolve(
        self, a: int, b: int, k: int, lowest: int, highest: int, weights: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the sum of a_j b_{k-j} over lowest <= j <= highest, with a_j times weights[j], and its error bound."""
        if highest < lowest:
            return np.zeros(self._batch), np.zeros(self._batch)
        left = slice(lowest, highest + 1)
        stop = k - highest - 1
        right = slice(k - lowest, stop if stop >= 0 else None, -1)
        ma, mag, abs_a = self._m[a, left], self._r[a, left], self._abs[a, left]
        if weights is not None:
            w = weights[left, None]
            ma, mag, abs_a = ma * w, mag * w, abs_a * w
        m = np.einsum("kb,kb->b", ma, self._m[b, right])
        r = np.einsum("kb,kb->b", abs_a, self._reach[b, right])
        r += np.einsum("kb,kb->b", mag, self._mag[b, right])
        return m, r * (1 + 2 * DOT) + TINY

    def _advance(self, i: int, k: int) -> None:
        """Compute order k >= 1 of node i from the lower orders of all nodes and order k of its operands."""
        node = self.tape.nodes[i]
        if node.operation == "state":
            return
        a = node.operands[0]
        b = node.operands[-1]
        fixed = self.tape.fixed
        weights = np.arange(k + 1) / k
        match node.operation:
            case "add":
                m = self._m[a, k] + self._m[b, k]
                r = (self._r[a, k] + self._r[b, k] + ULP * np.abs(m)) * (1 + DOT) + TINY
            case "sub":
                m, r = self._less(a, k, (self._m[b, k], self._r[b, k]))
            case "neg":
                m, r = -self._m[a, k], self._r[a, k]
            case "mul" if fixed[a]:
                m, r = self._fixed_times(a, b, k)
            case "mul" if fixed[b]:
                m, r = self._fixed_times(b, a, k)
            case "mul" | "power":
                m, r = self._convolve(a, b, k, 0, k)
            case "div" if fixed[b]:
                m, r = self._divide(self._m[a, k], self._r[a, k], b)
            case "div":
                m, r = self._less(a, k, self._convolve(b, i, k, 1, k))
                m, r = self._divide(m, r, b)
            case "sqrt":
                m, r = self._less(a, k, self._convolve(i, i, k, 1, k - 1))
                m, r = self._divide(0.5 * m, 0.5 * r + TINY, i)
            case "exp":
                m, r = self._convolve(a, i, k, 1, k, weights)
            case "log":
                m, r = self._less(a, k, self._convolve(i, a, k, 1, k - 1, weights))
                m, r = self._divide(m, r, a)
            case "sin":
                m, r = self._convolve(a, self.tape.partners(i)[-1], k, 1, k, weights)
            case "cos":
                m, r = self._convolve(a, self.tape.partners(i)[-1], k, 1, k, weights)
                m = -m
            case "tanh":
                # g_k = sum (j/k) a_j (1 - g^2)_{k-j} = a_k - sum (j/k) a_j (g^2)_{k-j}
                m, r = self._less(a, k, self._convolve(a, self.tape.partners(i)[-1], k, 1, k, weights))
            case _:
                raise AssertionError(node.operation)
        self._store(i, k, m, r)

    def _fixed_times(self, a: int, b: int, k: int) -> tuple[np.ndarray, np.ndarray]:
        """Return a_0 b_k for an a that is constant in time."""
        m = self._m[a, 0] * self._m[b, k]
        r = self._abs[a, 0] * self._r[b, k] + self._r[a, 0] * self._mag[b, k]
        return m, (r + ULP * np.abs(m)) * (1 + DOT) + TINY

    def _less(self, a: int, k: int, other: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        m = self._m[a, k] - other[0]
        return m, (self._r[a, k] + other[1] + ULP * np.abs(m)) * (1 + DOT) + TINY

    def _divide(self, m: np.ndarray, r: np.ndarray, b: int) -> tuple[np.ndarray, np.ndarray]:
        """Return (m +- r) / b_0 by an interval division. b_0 does not contain zero; order 0 checked that."""
        quotient = Interval(np.nextafter(m - r, -np.inf), np.nextafter(m + r, np.inf)) / self._first[b]
        middle = quotient.middle()
        return middle, quotient.radius(middle)
