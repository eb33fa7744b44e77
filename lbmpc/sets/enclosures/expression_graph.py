"""A plant's equations as elementary operations, read from CasADi and differentiated without rounding.

CasADi's own derivatives are not used, because they fold constants in floating point.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import casadi as ca

CASADI = {getattr(ca, name): name[3:].lower() for name in dir(ca) if name.startswith("OP_")}
"""Names of CasADi's instructions by number."""
CONJUGATE = {"sin": "cos", "cos": "sin"}
"""Each function needs the series of the other one."""


class UnsupportedOperation(ValueError):
    """The plant's equations use an operation without rigorous series; `leaves` are the states and inputs involved."""

    def __init__(self, operation: str, leaves: tuple[Node, ...]):
        super().__init__(
            f"the disturbance cannot be bounded rigorously: the plant's equations use `{operation}`, which is not "
            "among + - * / sqrt exp log sin cos tanh and powers; write them with these, or give W yourself "
            "(--kind given)"
        )
        self.operation, self.leaves = operation, leaves


@dataclass(frozen=True)
class Node:
    """One operation. `number` is a constant or an integer exponent; `index` is that of a state or an input."""

    operation: str
    operands: tuple[int, ...] = ()
    number: float = 0.0
    index: int = -1


def leaves(nodes: Sequence[Node], operands: Sequence[int]) -> tuple[Node, ...]:
    """Return the states and inputs that some of the nodes depend on, states first."""
    found, seen, pending = set(), set(), list(operands)
    while pending:
        i = pending.pop()
        if i not in seen:
            seen.add(i)
            pending.extend(nodes[i].operands)
            if nodes[i].operation in ("state", "input"):
                found.add(nodes[i])
    return tuple(sorted(found, key=lambda node: (node.operation == "input", node.index)))


class Graph:
    """Elementary operations in order of evaluation. Equal operations are stored once."""

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
        """Return the node of a b. Products of one quantity become powers, whose enclosures are tight."""
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

    def function(self, operation: str, a: int) -> int:
        """Return the node of sqrt, exp, log, sin, cos, tanh or neg, and add the nodes that its series needs."""
        result = self.add(Node(operation, (a,)))
        if operation in CONJUGATE:
            self.add(Node(CONJUGATE[operation], (a,)))
        elif operation == "tanh":
            self.power(result, 2)
        return result

    def read(self, function: ca.Function) -> list[int]:
        """Return the nodes of the outputs of f(x, u).

        Raises:
            UnsupportedOperation: an operation has no series here. The text names it.
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
                return self.function(name, a)
            case "pow" | "constpow":
                return self._general_power(a, b)
        raise UnsupportedOperation(name, self.leaves(operands))

    def _general_power(self, a: int, b: int) -> int:
        exponent = self.nodes[b]
        if exponent.operation == "constant" and exponent.number == int(exponent.number):
            n = int(exponent.number)
            return self.power(a, n) if n >= 0 else self.divide(self.constant(1.0), self.power(a, -n))
        if exponent.operation == "constant" and exponent.number == 0.5:
            return self.function("sqrt", a)
        return self.function("exp", self.times(b, self.function("log", a)))

    def leaves(self, operands: Sequence[int]) -> tuple[Node, ...]:
        """Return the states and inputs that these nodes depend on, states first."""
        return leaves(self.nodes, operands)

    def derivative(self, output: int, seed: int) -> int | None:
        """Return the node of d(output)/d(seed); None if it is structurally zero."""
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
                return self.times(self.function("cos", a), da)
            case "cos":
                return self._scaled(-1.0, self.times(self.function("sin", a), da))
            case "tanh":
                slope = self.add(Node("sub", (self.constant(1.0), self.power(i, 2))))
                return self.times(slope, da)
        raise AssertionError(node.operation)

    def total(self, terms: Sequence[int | None]) -> int | None:
        """Return the sum of the terms that are not structurally zero."""
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
