"""The motion of a linear model within a period: x(t + s) from x(t) under a constant input, in deviations.

In continuous time, dx/dt = a x + b u, it is given by exp([[a, b], [0, 0]] s). A discrete-time model x+ = A x + B u has
such an a and b if [[A, B], [0, I]] has a real logarithm, which inverts the zero-order hold. There is none if A has a
negative eigenvalue, or a zero one as with a dead time. The motion between two states is then unknown and is replaced
by a straight line.
"""

from __future__ import annotations

import math
import warnings
from functools import cached_property
from typing import Protocol

import casadi as ca
import numpy as np
from scipy.linalg import expm, logm

from lbmpc.casadi_buffers import Bound
from lbmpc.plants.description import Description
from lbmpc.plants.known import Known

Pieces = tuple[tuple[float, np.ndarray], ...]
"""Intervals with one input each: (seconds, u (m,))."""

# Up to two periods the argument of the series has a norm of at most 2 * SERIES_NORM = 1, so the truncation error is
# below 1 / 19! = 8e-18.
SERIES_NORM = 0.5
TERMS = 19

BACK = 1e-9
"""Largest error of exp(log M) relative to the largest entry of M for an acceptable logarithm."""
EXCURSION = 10.0
"""Largest ratio of M^(1/2) to M and the identity. A logarithm that consists of rounding errors, near an eigenvalue of
zero, exceeds it by far."""


class LinearMotion(Protocol):
    """The motion within a period, and the response to several inputs."""

    def after(self, x: np.ndarray, u: np.ndarray, seconds: float) -> np.ndarray:
        """Return the state, (d,), `seconds` after x, (d,), under the input u, (m,)."""
        ...

    def answer(self, pieces: Pieces) -> np.ndarray:
        """Return the state, (d,), one period after the equilibrium, under the inputs of `pieces` in turn."""
        ...


class Continuous:
    """The motion dx/dt = a x + b u. `after` is fast enough for every tick.

    Up to two periods it uses a series, which equals `discretise` to rounding and takes a tenth of the time.

    Args:
        a, b: (d, d) and (d, m).
        period: T in seconds.
        units: units of (x, u), (d + m,), as returned by `balanced`.
    """

    def __init__(self, a: np.ndarray, b: np.ndarray, period: float, units: np.ndarray):
        self.a, self.b, self.period, self.units = a, b, period, units

    def after(self, x: np.ndarray, u: np.ndarray, seconds: float) -> np.ndarray:
        if not 0.0 <= seconds <= 2.0 * self.period:
            phi, gamma = discretise(self.a, self.b, seconds, self.units)
            return phi @ x + gamma @ u
        held = self._held
        inputs = held.inputs
        inputs["x"][:, 0], inputs["u"][:, 0], inputs["share"][0, 0] = x, u, seconds / self.period
        held()
        return held.outputs["after"][:, 0].copy()

    def answer(self, pieces: Pieces) -> np.ndarray:
        x = np.zeros(len(self.a))
        for seconds, u in pieces:
            x = self.after(x, u, seconds)
        return x

    @cached_property
    def _held(self) -> Bound:
        """Function (x, u, share) -> the state after this share of a period.

        Each entry of exp([[a, b], [0, 0]] seconds / 2^squarings), in balanced units, is a polynomial in the share.
        Repeated squaring gives the result.
        """
        d, m = self.b.shape
        units = self.units
        block = _block(self.a, self.b) * self.period * units / units[:, None]
        squarings = max(0, math.ceil(math.log2(max(np.abs(block).sum(axis=0).max(), 1e-300) / SERIES_NORM)))
        block /= 2.0**squarings
        terms = [np.eye(d + m)]
        for k in range(1, TERMS):
            terms.append(terms[-1] @ block / k)
        share = ca.SX.sym("share")
        series = ca.DM(terms[-1])
        for term in reversed(terms[:-1]):
            series = ca.sparsify(ca.DM(term)) + share * series
        held = ca.Function("series", [share], [ca.densify(series)])
        x, u, part = ca.MX.sym("x", d), ca.MX.sym("u", m), ca.MX.sym("share")
        power = held(part)
        for _ in range(squarings):
            power = power @ power
        after = (power[:d, :d] @ (x / units[:d]) + power[:d, d:] @ (u / units[d:])) * units[:d]
        return Bound(ca.Function("held", [x, u, part], [after], ["x", "u", "share"], ["after"]))


class StraightLine:
    """A straight line from one state of x+ = A x + B u to the next, for a model without a usable logarithm.

    If several inputs act within a period, their mean is used.
    """

    def __init__(self, A: np.ndarray, B: np.ndarray, period: float):
        self.A, self.B, self.period = A, B, period

    def after(self, x: np.ndarray, u: np.ndarray, seconds: float) -> np.ndarray:
        share = seconds / self.period
        while share >= 1.0:
            x, share = self.A @ x + self.B @ u, share - 1.0
        return x + share * (self.A @ x + self.B @ u - x)

    def answer(self, pieces: Pieces) -> np.ndarray:
        return self.B @ sum(seconds / self.period * u for seconds, u in pieces)


def within_period(known: Known, period: float) -> LinearMotion:
    """Return the motion of this model; `period` is in seconds, and equals the model's own in discrete time."""
    units = balanced(known)
    if known.period is None:
        return Continuous(known.A, known.B, period, units)
    block = _logarithm(known.A, known.B, units)
    if block is None:
        return StraightLine(known.A, known.B, known.period)
    d = known.d
    return Continuous(block[:d, :d] / known.period, block[:d, d:] / known.period, known.period, units)


def _logarithm(A: np.ndarray, B: np.ndarray, units: np.ndarray) -> np.ndarray | None:
    """Return the real [[a, b], [0, 0]] T whose exponential is [[A, B], [0, I]]; None if there is no accurate one."""
    d, m = B.shape
    whole = np.vstack([np.hstack([A, B]), np.hstack([np.zeros((m, d)), np.eye(m)])]) * units / units[:, None]
    if not (np.abs(np.linalg.eigvals(A)) > np.finfo(float).tiny).all():
        return None
    with warnings.catch_warnings():
        # The accuracy is checked below.
        warnings.simplefilter("ignore", RuntimeWarning)
        block = logm(whole)
    if not np.isfinite(block).all() or np.abs(block.imag).max() > BACK:
        return None
    block = block.real
    block[d:] = 0.0
    size = np.abs(whole).max()
    accurate = np.abs(expm(block) - whole).max() <= BACK * size
    half = np.abs(expm(0.5 * block)).max()
    return block * units[:, None] / units if accurate and half <= EXCURSION * max(size, 1.0) else None


def balanced(plant: Description) -> np.ndarray:
    """Return units of (x, u), (d + m,), near the half-widths, in which matrix equations are solved.

    Without them a state in pascals beside one in metres would cost digits. The units are powers of two, so that the
    conversion is exact.
    """
    return np.exp2(np.rint(np.log2(np.concatenate([plant.x_scale, plant.u_scale]))))


def discretise(
    a: np.ndarray, b: np.ndarray, period: float, units: np.ndarray | float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    """Return the exact zero-order hold exp([[a, b], [0, 0]] T), computed in the given units of (x, u), (d + m,)."""
    d, m = b.shape
    units = np.broadcast_to(units, d + m)
    exponential = expm(_block(a, b) * period * units / units[:, None]) * units[:, None] / units
    return exponential[:d, :d], exponential[:d, d:]


def _block(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return [[a, b], [0, 0]]."""
    return np.vstack([np.hstack([a, b]), np.zeros((b.shape[1], sum(b.shape)))])
