"""Interval arithmetic on numpy arrays with outward rounding.

Every operation returns an interval that contains all real results for its operands. +, -, *, / and sqrt are rounded to
nearest by IEEE 754, so one step of `nextafter` outwards is enough. numpy documents errors below 4 units in the last
place for exp, log, sin, cos and tanh; `LIBRARY_ULPS` units are added here. The names follow IEEE 1788: an interval is
`lower` <= `upper`, elementwise. It may be unbounded after an overflow, and it is never empty.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

LIBRARY_ULPS = 8
# Larger angles are not reduced by multiples of pi; sin is then in [-1, 1].
LARGEST_ANGLE = 1e5


class DomainError(ArithmeticError):
    """An operand leaves the domain of the operation; `where` is a mask over the batch.

    `leaves` are the states and inputs that the operand depends on, as nodes of the graph, if they are known.
    """

    def __init__(self, operation: str, where: np.ndarray, leaves: tuple[Any, ...] = ()):
        super().__init__(f"the argument of {operation} leaves the domain in which it is defined and smooth")
        self.operation = operation
        self.where = where
        self.leaves = leaves


def down(value: Any) -> np.ndarray:
    """Return a number below every real number that rounds to `value`."""
    return np.nextafter(value, -np.inf)


def up(value: Any) -> np.ndarray:
    """Return a number above every real number that rounds to `value`."""
    return np.nextafter(value, np.inf)


@dataclass(frozen=True, eq=False)
class Interval:
    """An array of intervals [lower, upper]. Both arrays have the same shape, (...)."""

    lower: np.ndarray
    upper: np.ndarray

    @classmethod
    def of(cls, value: Any) -> Interval:
        """Return floats as intervals of zero width."""
        if isinstance(value, Interval):
            return value
        array = np.asarray(value, dtype=float)
        return cls(array, array)

    @property
    def shape(self) -> tuple[int, ...]:
        return np.shape(self.lower)

    def __getitem__(self, index: Any) -> Interval:
        return Interval(self.lower[index], self.upper[index])

    def middle(self) -> np.ndarray:
        """Return a float inside the interval, near its centre."""
        return np.clip(0.5 * self.lower + 0.5 * self.upper, self.lower, self.upper)

    def radius(self, middle: np.ndarray | None = None) -> np.ndarray:
        """Return the smallest float known to reach both ends from `middle`, rounded up."""
        m = self.middle() if middle is None else middle
        return np.maximum(up(np.maximum(m - self.lower, self.upper - m)), 0.0)

    def magnitude(self) -> np.ndarray:
        """Return max |x| over the interval; exact."""
        return np.maximum(np.abs(self.lower), np.abs(self.upper))

    def meet(self, other: Interval) -> Interval:
        """Return the intersection of two enclosures of the same quantity, which is never empty."""
        return Interval(np.maximum(self.lower, other.lower), np.minimum(self.upper, other.upper))

    def __neg__(self) -> Interval:
        return Interval(-self.upper, -self.lower)

    def __add__(self, other: Any) -> Interval:
        o = Interval.of(other)
        with np.errstate(over="ignore", invalid="ignore"):
            return Interval(down(self.lower + o.lower), up(self.upper + o.upper))

    def __sub__(self, other: Any) -> Interval:
        o = Interval.of(other)
        with np.errstate(over="ignore", invalid="ignore"):
            return Interval(down(self.lower - o.upper), up(self.upper - o.lower))

    def __mul__(self, other: Any) -> Interval:
        o = Interval.of(other)
        with np.errstate(invalid="ignore", over="ignore"):
            products = [a * b for a in (self.lower, self.upper) for b in (o.lower, o.upper)]
        # An infinite end stands for unbounded real numbers, and zero times any of them is zero.
        products = [np.where(np.isnan(p), 0.0, p) if np.isnan(p).any() else p for p in products]
        low = np.minimum(np.minimum(products[0], products[1]), np.minimum(products[2], products[3]))
        high = np.maximum(np.maximum(products[0], products[1]), np.maximum(products[2], products[3]))
        return Interval(down(low), up(high))

    def __truediv__(self, other: Any) -> Interval:
        o = Interval.of(other)
        _require((o.lower > 0) | (o.upper < 0), "a division")
        with np.errstate(over="ignore", invalid="ignore"):
            quotients = [a / b for a in (self.lower, self.upper) for b in (o.lower, o.upper)]
        if any(np.isnan(q).any() for q in quotients):  # infinity over infinity: no bound
            everything = np.full(np.broadcast(self.lower, o.lower).shape, np.inf)
            return Interval(-everything, everything)
        low = np.minimum(np.minimum(quotients[0], quotients[1]), np.minimum(quotients[2], quotients[3]))
        high = np.maximum(np.maximum(quotients[0], quotients[1]), np.maximum(quotients[2], quotients[3]))
        return Interval(down(low), up(high))

    def __radd__(self, other: Any) -> Interval:
        return self + other

    def __rmul__(self, other: Any) -> Interval:
        return self * other

    def __rsub__(self, other: Any) -> Interval:
        return Interval.of(other) - self

    def __rtruediv__(self, other: Any) -> Interval:
        return Interval.of(other) / self

    def power(self, exponent: int) -> Interval:
        """Return x^n for an integer n >= 0, tight for both signs of x."""
        if exponent == 0:
            return Interval.of(np.ones(self.shape))
        if exponent % 2:
            return Interval(_power(self.lower, exponent, down), _power(self.upper, exponent, up))
        far = self.magnitude()
        near = np.where(
            (self.lower <= 0) & (self.upper >= 0), 0.0, np.minimum(np.abs(self.lower), np.abs(self.upper))
        )
        return Interval(np.maximum(_power(near, exponent, down), 0.0), _power(far, exponent, up))

    def sqrt(self) -> Interval:
        """Return the root of x > 0. At zero it has no derivative, so no flow through zero can be enclosed."""
        _require(self.lower > 0, "sqrt")
        return Interval(np.maximum(down(np.sqrt(self.lower)), 0.0), up(np.sqrt(self.upper)))

    def exp(self) -> Interval:
        with np.errstate(over="ignore", under="ignore"):
            low, high = np.exp(self.lower), np.exp(self.upper)
        return Interval(np.maximum(_widen(low, -1), 0.0), _widen(high, +1))

    def log(self) -> Interval:
        _require(self.lower > 0, "log")
        return Interval(_widen(np.log(self.lower), -1), _widen(np.log(self.upper), +1))

    def tanh(self) -> Interval:
        low, high = np.tanh(self.lower), np.tanh(self.upper)
        return Interval(np.maximum(_widen(low, -1), -1.0), np.minimum(_widen(high, +1), 1.0))

    def sin(self) -> Interval:
        return self._wave(np.sin, 0.25)

    def cos(self) -> Interval:
        return self._wave(np.cos, 0.0)

    def _wave(self, function: Any, top: float) -> Interval:
        """Enclose a function of period 2 pi with maximum 1 at 2 pi (n + top) and minimum -1 half a period later."""
        tame = (self.magnitude() < LARGEST_ANGLE) & (self.upper - self.lower < 6.0)
        low_at, high_at = np.where(tame, self.lower, 0.0), np.where(tame, self.upper, 0.0)
        a, b = function(low_at), function(high_at)
        # In turns, with a slack far above rounding. A superfluous extremum only widens the result.
        first, last = low_at / (2 * np.pi) - 1e-9, high_at / (2 * np.pi) + 1e-9
        crest = np.floor(last - top) >= np.ceil(first - top)
        trough = np.floor(last - top - 0.5) >= np.ceil(first - top - 0.5)
        low = np.where(trough | ~tame, -1.0, np.maximum(_widen(np.minimum(a, b), -1), -1.0))
        high = np.where(crest | ~tame, 1.0, np.minimum(_widen(np.maximum(a, b), +1), 1.0))
        return Interval(low, high)


def matrix_product(a: Interval, b: Interval) -> Interval:
    """Return the matrix product (..., i, j) @ (..., j, k); each entry encloses the exact sum."""
    terms = Interval(a.lower[..., :, :, None], a.upper[..., :, :, None]) * Interval(
        b.lower[..., None, :, :], b.upper[..., None, :, :]
    )
    total = terms[..., 0, :]
    for j in range(1, terms.shape[-2]):
        total = total + terms[..., j, :]
    return total


def _power(value: np.ndarray, exponent: int, outwards: Any) -> np.ndarray:
    """Return value^exponent, rounded by `outwards` at every product. It is valid because |value|^i is monotone."""
    size = np.abs(value)
    # Outwards is away from zero for an upper bound of a positive or a lower bound of a negative number.
    grow = (value > 0) == (outwards is up)
    result = size
    with np.errstate(over="ignore", under="ignore"):
        for _ in range(exponent - 1):
            result = np.where(grow, up(result * size), np.maximum(down(result * size), 0.0))
    result = np.where(size > 0, result, 0.0)
    return np.where(value < 0, -result, result) if exponent % 2 else result


def _widen(value: np.ndarray, sign: int) -> np.ndarray:
    """Return a bound for the result of a library function with an error of a few units in the last place."""
    with np.errstate(over="ignore"):
        return value + sign * (np.abs(value) * (LIBRARY_ULPS * 2.3e-16) + 1e-307)


def _require(good: np.ndarray, operation: str) -> None:
    if not np.all(good):
        raise DomainError(operation, ~np.asarray(good))
