"""Taylor series in time of expressions along a flow, with balls as coefficients.

A `Graph` holds a plant's equations as elementary operations, reads them from CasADi, and differentiates them without
rounding (CasADi's own derivatives fold constants in floating point). `Tape` runs it order by order for a batch of
boxes: if all operands are known to order k, so is every result. Time is in units of the step, so that coefficient k
already carries the step's k-th power.

Order 0 is an interval operation and tight. Higher orders use balls, middle +- radius: for the sums of products that
make up a Taylor recurrence they need three plain products where intervals need four products and their extrema, and
what they lose is of third order in the size of the box.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from lbmpc.sets.enclosures.interval import Interval

# A sum of up to 40 products of floats, in any order, is off by less than 41 * 2^-53 = 4.6e-15 of the sum of their
# magnitudes (Higham, Accuracy and Stability, 3.1); DOT is twice that, for the arithmetic on the bound itself. TINY is
# far more than 40 products can lose by underflow.
MOST_ORDERS = 40
DOT = 1e-14
ULP = 2.3e-16
TINY = 1e-300

CASADI = {getattr(ca, name): name[3:].lower() for name in dir(ca) if name.startswith("OP_")}


class UnsupportedOperation(ValueError):
    """The plant's equations use an operation for which there are no rigorous series."""


@dataclass(frozen=True)
class Node:
    """One operation: `number` is a constant's value or an integer exponent, `index` that of a state or an input."""

    operation: str
    operands: tuple[int, ...] = ()
    number: float = 0.0
    index: int = -1


class Graph:
    """Elementary operations in the order of evaluation; equal operations are stored once."""

    def __init__(self) -> None:
        self.nodes: list[Node] = []
        self._known: dict[Node, int] = {}

    def add(self, node: Node) -> int:
        if node not in self._known:
            self._known[node] = len(self.nodes)
            self.nodes.append(node)
        return self._known[node]

    def state(self, index: int) -> int:
        return self.add(Node("state", index=index))

    def input(self, index: int) -> int:
        return self.add(Node("input", index=index))

    def constant(self, value: float) -> int:
        return self.add(Node("constant", number=float(value)))

    def sum(self, a: int, b: int) -> int:
        return self.add(Node("add", (a, b)))

    def times(self, a: int, b: int) -> int:
        """a b; powers of one quantity are kept as powers, which are tight where products are not."""
        one = Node("constant", number=1.0)
        if self.nodes[a] == one:
            return b
        if self.nodes[b] == one:
            return a
        if a == b:
            return self.power(a, 2)
        for base, other in ((a, b), (b, a)):
            if self.nodes[other].operation == "power" and self.nodes[other].operands[0] == base:
                return self.power(base, int(self.nodes[other].number) + 1)
        return self.add(Node("mul", (a, b)))

    def power(self, a: int, exponent: int) -> int:
        if exponent == 0:
            return self.constant(1.0)
        if exponent == 1:
            return a
        return self.add(Node("power", (a, self.power(a, exponent - 1)), number=float(exponent)))

    def divide(self, a: int, b: int) -> int:
        return self.add(Node("div", (a, b)))

    def wave(self, operation: str, a: int) -> int:
        """sin or cos: the series of each needs the other one's."""
        other = "cos" if operation == "sin" else "sin"
        first = self.add(Node(operation, (a,)))
        self.add(Node(other, (a,)))
        return first

    def tanh(self, a: int) -> int:
        result = self.add(Node("tanh", (a,)))
        self.power(result, 2)
        return result

    def unary(self, operation: str, a: int) -> int:
        if operation in ("sin", "cos"):
            return self.wave(operation, a)
        if operation == "tanh":
            return self.tanh(a)
        return self.add(Node(operation, (a,)))

    def read(self, function: ca.Function) -> list[int]:
        """Nodes of the outputs of f(x, u).

        Raises:
            UnsupportedOperation: an operation that has no series here; the text names it.
        """
        work: dict[int, int] = {}
        outputs: dict[int, int] = {}
        for i in range(function.n_instructions()):
            name = CASADI.get(function.instruction_id(i), f"operation {function.instruction_id(i)} of CasADi")
            source, target = function.instruction_input(i), function.instruction_output(i)
            if name == "input":
                work[target[0]] = (self.state, self.input)[source[0]](source[1])
            elif name == "const":
                work[target[0]] = self.constant(function.instruction_constant(i))
            elif name == "output":
                outputs[target[1]] = work[source[0]]
            else:
                work[target[0]] = self._operation(name, [work[s] for s in source])
        # An output that is identically zero has no instruction.
        return [outputs[i] if i in outputs else self.constant(0.0) for i in range(function.numel_out(0))]

    def _operation(self, name: str, operands: list[int]) -> int:
        a, b = operands[0], operands[-1]
        match name:
            case "assign":
                return a
            case "add":
                return self.sum(a, b)
            case "sub":
                return self.add(Node("sub", (a, b)))
            case "mul":
                return self.times(a, b)
            case "div":
                return self.divide(a, b)
            case "inv":
                return self.divide(self.constant(1.0), a)
            case "sq":
                return self.power(a, 2)
            case "twice":
                return self.times(self.constant(2.0), a)
            case "neg" | "sqrt" | "exp" | "log" | "sin" | "cos" | "tanh":
                return self.unary(name, a)
            case "pow" | "constpow":
                return self._general_power(a, b)
        raise UnsupportedOperation(
            f"the disturbance cannot be bounded rigorously: the plant's equations use `{name}`, which is not among "
            "+ - * / sqrt exp log sin cos tanh and powers; write them with these, or give W yourself"
        )

    def _general_power(self, a: int, b: int) -> int:
        exponent = self.nodes[b]
        if exponent.operation == "constant" and exponent.number == int(exponent.number):
            n = int(exponent.number)
            return self.power(a, n) if n >= 0 else self.divide(self.constant(1.0), self.power(a, -n))
        if exponent.operation == "constant" and exponent.number == 0.5:
            return self.unary("sqrt", a)
        return self.unary("exp", self.times(b, self.unary("log", a)))

    def derivative(self, output: int, seed: int) -> int | None:
        """Node of d(output)/d(seed); None where it is zero by structure."""
        known: dict[int, int | None] = {seed: self.constant(1.0)}

        def of(i: int) -> int | None:
            if i not in known:
                known[i] = self._rule(i, of)
            return known[i]

        return of(output)

    def _rule(self, i: int, of: Callable[[int], int | None]) -> int | None:
        node = self.nodes[i]
        if not node.operands:
            return None
        a = node.operands[0]
        b = node.operands[-1]
        da = of(a)
        match node.operation:
            case "add":
                return self.total([da, of(b)])
            case "sub":
                return self.total([da, self._scaled(-1.0, of(b))])
            case "neg":
                return self._scaled(-1.0, da)
            case "mul":
                return self.total([self._by(da, b), self._by(of(b), a)])
            case "div":
                top = self.total([da, self._scaled(-1.0, self._by(of(b), i))])
                return None if top is None else self.divide(top, b)
        if da is None:
            return None
        match node.operation:
            case "power":
                return self._scaled(node.number, self._by(da, self.power(a, int(node.number) - 1)))
            case "sqrt":
                return self.divide(da, self.times(self.constant(2.0), i))
            case "exp":
                return self.times(i, da)
            case "log":
                return self.divide(da, a)
            case "sin":
                return self.times(self.unary("cos", a), da)
            case "cos":
                return self._scaled(-1.0, self.times(self.unary("sin", a), da))
            case "tanh":
                slope = self.add(Node("sub", (self.constant(1.0), self.power(i, 2))))
                return self.times(slope, da)
        raise AssertionError(node.operation)

    def total(self, terms: Sequence[int | None]) -> int | None:
        """Sum of what is not zero by structure."""
        present = [term for term in terms if term is not None]
        if not present:
            return None
        result = present[0]
        for term in present[1:]:
            result = self.sum(result, term)
        return result

    def _by(self, a: int | None, b: int) -> int | None:
        return None if a is None else self.times(a, b)

    def _scaled(self, factor: float, a: int | None) -> int | None:
        if a is None:
            return None
        return self.add(Node("neg", (a,))) if factor == -1.0 else self.times(self.constant(factor), a)


class Tape:
    """The series of dx/dt = outputs(x, u) for constant u, over a batch of boxes of x and u."""

    def __init__(self, graph: Graph, outputs: Sequence[int]):
        self.nodes = list(graph.nodes)
        self.outputs = list(outputs)
        self._where = {node: i for i, node in enumerate(self.nodes)}
        self._needed = self._reach()
        self._fixed = self._fixed_in_time()
        # States that are not read by any equation still have a series.
        self._states = {node.index: i for i, node in enumerate(self.nodes) if node.operation == "state"}

    def _partners(self, i: int) -> tuple[int, ...]:
        node = self.nodes[i]
        if node.operation in ("sin", "cos"):
            other = "cos" if node.operation == "sin" else "sin"
            return (*node.operands, self._where[Node(other, node.operands)])
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
                pending.extend(self._partners(i))
        return sorted(needed)

    def _fixed_in_time(self) -> list[bool]:
        fixed: list[bool] = []
        for node in self.nodes:
            fixed.append(node.operation != "state" and all(fixed[j] for j in node.operands))
        return fixed

    def series(self, x: Sequence[Interval], u: Sequence[Interval], step: Interval, orders: int) -> Run:
        """Coefficients 0..`orders` of every state, x[i] and u[j] of shape (batch,), in units of `step` seconds.

        Raises:
            DomainError: a root, logarithm or division meets what it is not defined for, in some boxes.
        """
        return Run(self, x, u, step, orders)


class Run:
    """One evaluation of a tape: Taylor coefficients of all its nodes."""

    def __init__(self, tape: Tape, x: Sequence[Interval], u: Sequence[Interval], step: Interval, orders: int):
        if orders > MOST_ORDERS - 2:
            raise ValueError(f"{orders} orders asked for, at most {MOST_ORDERS - 2} are rounded rightly")
        self.tape, self.orders = tape, orders
        batch = x[0].shape[0]
        d = len(x)
        count = len(tape.nodes)
        self._first: list[Interval | None] = [None] * count
        # Nodes first, then the states: a state that is read by an equation shares its node's rows.
        rows = count + d
        self._m = np.zeros((rows, orders + 1, batch))
        self._r = np.zeros((rows, orders + 1, batch))
        self._abs = np.zeros((rows, orders + 1, batch))
        self._mag = np.zeros((rows, orders + 1, batch))
        self._reach = np.zeros((rows, orders + 1, batch))
        self._state = [tape._states.get(i, count + i) for i in range(d)]
        self._batch = batch
        self._start(x, u)
        for k in range(orders):
            if k:
                for i in tape._needed:
                    if not tape._fixed[i]:
                        self._advance(i, k)
            factor = step / float(k + 1)
            fm, fr = float(factor.middle()), float(factor.radius())
            for i, output in enumerate(tape.outputs):
                m, r = self._scale(output, k, fm, fr)
                self._store(self._state[i], k + 1, m, r)

    def coefficients(self, k: int) -> Interval:
        """The k-th coefficient of every state, (states, batch)."""
        m, r = self._m[self._state, k], self._r[self._state, k]
        return Interval(np.nextafter(m - r, -np.inf), np.nextafter(m + r, np.inf))

    def _start(self, x: Sequence[Interval], u: Sequence[Interval]) -> None:
        first = self._first
        for i in self.tape._needed:
            node = self.tape.nodes[i]
            first[i] = self._zeroth(node, x, u)
            self._store_interval(i, first[i])
        for i, value in enumerate(x):
            self._store_interval(self._state[i], value)

    def _zeroth(self, node: Node, x: Sequence[Interval], u: Sequence[Interval]) -> Interval:
        if node.operation == "state":
            return x[node.index]
        if node.operation == "input":
            return u[node.index]
        if node.operation == "constant":
            return Interval.of(np.full(self._batch, node.number))
        a = self._known(node.operands[0])
        match node.operation:
            case "add":
                return a + self._known(node.operands[1])
            case "sub":
                return a - self._known(node.operands[1])
            case "mul":
                return a * self._known(node.operands[1])
            case "div":
                return a / self._known(node.operands[1])
            case "power":
                return a.power(int(node.number))
            case "neg":
                return -a
        return getattr(a, node.operation)()

    def _known(self, i: int) -> Interval:
        value = self._first[i]
        assert value is not None
        return value

    def _store_interval(self, i: int, value: Interval | None) -> None:
        assert value is not None
        m = value.middle()
        self._store(i, 0, m, value.radius(m))

    def _store(self, i: int, k: int, m: np.ndarray, r: np.ndarray) -> None:
        size = np.abs(m)
        self._m[i, k], self._r[i, k], self._abs[i, k] = m, r, size
        self._mag[i, k] = size + r
        # The rounding of a sum of products rides on the second factor's radius.
        self._reach[i, k] = r + DOT * size

    def _scale(self, i: int, k: int, factor: float, radius: float) -> tuple[np.ndarray, np.ndarray]:
        m = self._m[i, k] * factor
        r = self._r[i, k] * abs(factor) + self._mag[i, k] * radius
        return m, (r + ULP * np.abs(m)) * (1 + DOT) + TINY

    def _convolve(
        self, a: int, b: int, k: int, lowest: int, highest: int, weights: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """sum of a_j b_{k-j} over lowest <= j <= highest, a_j times weights[j] where given; rounded to be safe."""
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
        """Order k >= 1 of node i from the lower orders of everything and order k of its operands."""
        node = self.tape.nodes[i]
        if node.operation == "state":
            return
        a = node.operands[0]
        b = node.operands[-1]
        fixed = self.tape._fixed
        weights = np.arange(k + 1) / k
        match node.operation:
            case "add":
                m = self._m[a, k] + self._m[b, k]
                r = (self._r[a, k] + self._r[b, k] + ULP * np.abs(m)) * (1 + DOT) + TINY
            case "sub":
                m = self._m[a, k] - self._m[b, k]
                r = (self._r[a, k] + self._r[b, k] + ULP * np.abs(m)) * (1 + DOT) + TINY
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
                m, r = self._convolve(a, self._partner(i), k, 1, k, weights)
            case "cos":
                m, r = self._convolve(a, self._partner(i), k, 1, k, weights)
                m = -m
            case "tanh":
                # g_k = sum (j/k) a_j (1 - g^2)_{k-j} = a_k - sum (j/k) a_j (g^2)_{k-j}
                m, r = self._less(a, k, self._convolve(a, self._partner(i), k, 1, k, weights))
            case _:
                raise AssertionError(node.operation)
        self._store(i, k, m, r)

    def _fixed_times(self, a: int, b: int, k: int) -> tuple[np.ndarray, np.ndarray]:
        """a_0 b_k, where a does not change in time."""
        m = self._m[a, 0] * self._m[b, k]
        r = self._abs[a, 0] * self._r[b, k] + self._r[a, 0] * self._mag[b, k]
        return m, (r + ULP * np.abs(m)) * (1 + DOT) + TINY

    def _partner(self, i: int) -> int:
        return self.tape._partners(i)[-1]

    def _less(self, a: int, k: int, other: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        m = self._m[a, k] - other[0]
        return m, (self._r[a, k] + other[1] + ULP * np.abs(m)) * (1 + DOT) + TINY

    def _divide(self, m: np.ndarray, r: np.ndarray, b: int) -> tuple[np.ndarray, np.ndarray]:
        """(m +- r) / b_0, as an interval division: b_0 does not contain zero, or order 0 would have said so."""
        quotient = Interval(np.nextafter(m - r, -np.inf), np.nextafter(m + r, np.inf)) / self._known(b)
        middle = quotient.middle()
        return middle, quotient.radius(middle)
