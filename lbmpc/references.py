"""References of the outputs: piecewise linear in time, changed while the loop runs, and limited by a lease.

The module is pure. Time is counted in periods, so that a replay reproduces every value.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np

FOR_EVER = -1
"""Value of a lease without end."""
LONGEST = 2**53
"""Largest count of periods, exact both as a signed 64-bit integer and as a float."""
PREVIEWED = 5
"""Largest number of knots within a horizon. Each can need a search for its target."""
AT_ONCE = np.zeros(1)
ChangeKind = Literal["set", "hold", "configured"]


@dataclass(frozen=True, eq=False)
class Reference:
    """Outputs and their desired values, in deviations; p outputs, k knots."""

    outputs: tuple[int, ...]
    """Indices of the states that are outputs."""
    times: np.ndarray
    """(k,) seconds since the reference was given, ascending. Two equal times are a step."""
    values: np.ndarray
    """(k, p), linear between the knots, and constant before the first and after the last."""
    passed: int = 0
    """Periods since it was given."""
    left: int = FOR_EVER
    """Periods until the lease ends."""
    held: bool = False
    """Whether the plant is held at a state."""
    source: int = 0
    """Sender of the reference. Repeating the same reference only renews the lease."""

    def at(self, seconds: float) -> np.ndarray:
        """Return the value, (p,), `seconds` after the reference was given."""
        return _at(self.times, self.values, seconds, int(self.times.searchsorted(seconds, "right")))

    def advanced(self, periods: int) -> Reference | None:
        """Return the reference `periods` later; None if its lease has ended."""
        if self.left != FOR_EVER and self.left <= periods:
            return None
        left = self.left if self.left == FOR_EVER else self.left - periods
        return replace(self, passed=min(self.passed + periods, LONGEST), left=left)

    def to_arrays(self) -> dict[str, np.ndarray]:
        return {
            "outputs": np.array(self.outputs, dtype=np.int64),
            "times": self.times,
            "values": self.values,
            "count": np.array([self.passed, self.left, self.held, self.source], dtype=np.int64),
        }

    @classmethod
    def from_arrays(cls, arrays: dict[str, np.ndarray], d: int) -> Reference:
        """Restore a reference of a plant with d states.

        Raises:
            ValueError: an array is missing, unknown or not valid. The text is the name of the array.
        """
        expected = {"outputs": 1, "times": 1, "values": 2, "count": 1}
        for name in sorted(expected.keys() | arrays.keys()):
            if name not in arrays or arrays[name].ndim != expected.get(name):
                raise ValueError(name)
        outputs, times, values, count = (arrays[name] for name in expected)
        if outputs.dtype != np.int64 or len({*outputs.tolist()} & {*range(d)}) != len(outputs):
            raise ValueError("outputs")
        if (
            times.dtype != np.float64
            or not len(times)
            or not np.isfinite(times).all()
            or (np.diff(times) < 0).any()
        ):
            raise ValueError("times")
        if (
            values.shape != (len(times), len(outputs))
            or values.dtype != np.float64
            or not np.isfinite(values).all()
        ):
            raise ValueError("values")
        if count.dtype != np.int64 or count.shape != (4,) or count[0] < 0 or count[1] < FOR_EVER:
            raise ValueError("count")
        passed, left, held, source = count.tolist()
        return cls((*outputs.tolist(),), times, values, min(passed, LONGEST), left, bool(held), source)

    def repeats(self, change: Change) -> bool:
        """Return whether a change repeats this reference."""
        if change.source != self.source or self.held != (change.kind == "hold"):
            return False
        if self.held:
            return True
        times, values = change.points
        k = len(times)
        return (
            change.outputs == self.outputs
            and len(self.times) == k + (times[0] > 0.0)
            and np.array_equal(self.times[-k:], times)
            and np.array_equal(self.values[-k:], values)
        )


@dataclass(frozen=True, eq=False)
class Change:
    """A requested change. `configured` needs no other field."""

    kind: ChangeKind
    """`hold` holds the plant at its present state."""
    outputs: tuple[int, ...] = ()
    times: np.ndarray | None = None
    """(k,) as in `Reference`, from now on, none negative."""
    values: np.ndarray | None = None
    """(k, p)"""
    lease: int = FOR_EVER
    """Periods."""
    source: int = 0
    """Sender of the request."""

    @property
    def points(self) -> tuple[np.ndarray, np.ndarray]:
        """Times and values of `set`."""
        assert self.times is not None
        assert self.values is not None
        return self.times, self.values


class Preview(NamedTuple):
    """The part of a reference within a horizon of n steps."""

    positions: np.ndarray
    """(k,) steps from the start of the horizon, 0 to n, ascending; (1,) for a constant reference."""
    values: np.ndarray
    """(k, p)"""


def changed(
    present: Reference | None,
    change: Change,
    period: float,
    x: np.ndarray,
    aim: np.ndarray,
    own: tuple[int, ...],
) -> Reference | None:
    """Return the reference from now on; None means the configured one.

    Args:
        present: the reference in force, which may be the configured one.
        change: the request. If its first knot lies in the future, the reference moves there from its present value.
        period: seconds.
        x: present state, (d,), in deviations.
        aim: target of the present plan, (d,), as start of outputs without a reference.
        own: the outputs that `hold` applies to.
    """
    if change.kind == "configured":
        return None
    if present is not None and present.repeats(change):
        return replace(present, left=change.lease)
    if change.kind == "hold":
        return Reference(own, np.zeros(1), x[None, list(own)], 0, change.lease, True, change.source)
    times, values = change.points
    if times[0] > 0.0:
        begin = aim.copy()
        if present is not None:
            begin[list(present.outputs)] = present.at(present.passed * period)
        times = np.concatenate([[0.0], times])
        values = np.vstack([begin[list(change.outputs)], values])
    return Reference(change.outputs, times, values, 0, change.lease, False, change.source)


def preview(reference: Reference, ahead: float, period: float, n: int) -> Preview:
    """Return the part of a reference within a horizon that begins `ahead` seconds from now.

    If there are more knots than `PREVIEWED`, the first ones and the end are kept.
    """
    begin = reference.passed * period + ahead
    end = begin + n * period
    times, values = reference.times, reference.values
    if begin >= times[-1]:
        return Preview(AT_ONCE, values[-1:])
    after, until = int(times.searchsorted(begin, "right")), int(times.searchsorted(end, "left"))
    few = slice(after, min(until, after + PREVIEWED - 2))
    seen = [_at(times, values, begin, after), *values[few], _at(times, values, end, until)]
    if all((r == seen[0]).all() for r in seen[1:]):
        return Preview(AT_ONCE, seen[0][None])
    positions = [0.0, *((times[few] - begin) / period).tolist(), float(n)]
    return Preview(np.array(positions), np.array(seen))


def _at(times: np.ndarray, values: np.ndarray, t: float, after: int) -> np.ndarray:
    """Return the value, (p,), at t, which lies between the knots after - 1 and after."""
    if not 0 < after < len(times):
        return values[0] if after == 0 else values[-1]
    share = (t - times[after - 1]) / (times[after] - times[after - 1])
    return np.asarray(values[after - 1] + share * (values[after] - values[after - 1]))


def between(times: np.ndarray, values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Interpolate knots times (k,), values (k, p) at (a,); the result is (a, p). At a step the later value is used."""
    after = times.searchsorted(at, "right")
    first, last = np.maximum(after - 1, 0), np.minimum(after, len(times) - 1)
    length = times[last] - times[first]
    share = (at - times[first]) / np.where(length > 0.0, length, 1.0)
    return np.asarray(values[first] + share[:, None] * (values[last] - values[first]))
