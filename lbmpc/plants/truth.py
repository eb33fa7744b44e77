"""The true motion of a plant: what `TrueMotion` is, and the one of equations."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from math import isclose, isfinite, remainder
from typing import Any, NamedTuple, Protocol

import casadi as ca
import numpy as np

from lbmpc.casadi_buffers import Bound
from lbmpc.plants.description import PlantError
from lbmpc.plants.equations import Plant
from lbmpc.plants.known import Known
from lbmpc.plants.linear_motion import StraightLine, balanced, discretise, within_period

INTEGRATION_TOLERANCE = 1e-12


class TrueMotion(Protocol):
    """What the plant really does. The same numbers in, the same numbers out: nothing is kept between calls."""

    def step(self, x: np.ndarray, u: np.ndarray, dt: float) -> np.ndarray:
        """x(t + dt) from x(t) = x, (d,), under the constant input u, (m,); plant units, dt in seconds.

        Raises:
            PlantError: the motion cannot be followed.
        """
        ...


def true_motion(plant: Known | Plant | TrueMotion) -> TrueMotion:
    """How this plant moves where nothing else is said to be true; of somebody's own motion that."""
    if isinstance(plant, Known):
        return LinearTruth(plant)
    return Truth(plant) if isinstance(plant, Plant) else Own(plant)


class LinearTruth:
    """The true motion of numbers: the linear model is the truth, and h is zero."""

    def __init__(self, known: Known):
        self._known = known
        units = balanced(known)
        self._within = None if known.period is None else within_period(known, known.period)
        # Few lengths of time come back again and again.
        self._over = lru_cache(maxsize=64)(lambda dt: discretise(known.A, known.B, dt, units))

    def step(self, x: np.ndarray, u: np.ndarray, dt: float) -> np.ndarray:
        """As `TrueMotion` says. Raises `PlantError`: the numbers are not finite."""
        known = self._known
        dx, du = x - known.x_e, u - known.u_e
        if self._within is None:
            phi, gamma = self._over(dt)
            after = phi @ dx + gamma @ du
        else:
            self._require_motion(dt)
            after = self._within.after(dx, du, dt)
        if not np.isfinite(after).all():
            raise PlantError(f"{known.name}: the state is not finite: {after.tolist()}")
        return np.asarray(known.x_e + after)

    def _require_motion(self, dt: float) -> None:
        """A straight line does for a prediction. As a truth, two halves of it would not make a period."""
        within = self._within
        if not isinstance(within, StraightLine):
            return
        if not isclose(remainder(dt, within.period), 0.0, abs_tol=1e-6 * dt):
            raise PlantError(
                f"{self._known.name}: its A and B are in discrete time and have no motion between two samples, so that "
                "they cannot simulate an input that changes there, as any does that comes with a delay. Name something "
                "that moves: plant.truth"
            )


class Own:
    """Somebody's own motion: what it raises, or returns that is no state, ends the run with the cause."""

    def __init__(self, motion: TrueMotion):
        self._motion = motion
        self._name = type(motion).__name__

    def step(self, x: np.ndarray, u: np.ndarray, dt: float) -> np.ndarray:
        """As `TrueMotion.step`."""
        if dt <= 0.0:
            return np.array(x, dtype=float)
        try:
            after = np.array(self._motion.step(np.array(x), np.array(u), dt), dtype=float)
        except Exception as error:
            raise PlantError(f"{self._name}.step: {type(error).__name__}: {error}") from error
        if after.shape != np.shape(x):
            raise PlantError(
                f"{self._name}.step: it returned {after.shape} numbers, the state has {np.shape(x)}"
            )
        if not isfinite(sum(after.tolist())):
            raise PlantError(f"{self._name}.step: the state is not finite: {after.tolist()}")
        return after


class Truth:
    """The true motion of equations, integrated to a local error below 1e-9 half-widths over a sampling period.

    DOP853 (order 8, scipy) at rtol = 1e-12 and atol = 1e-12 half-widths. Deterministic: the same numbers in, the same
    numbers out.
    """

    def __init__(self, plant: Plant):
        self.plant = plant
        self._f = Bound(plant.function())
        self._whole = Bound(_whole_step(plant))

    def step(self, x: np.ndarray, u: np.ndarray, dt: float) -> np.ndarray:
        """x(t + dt) from x(t) = x, (d,), under the constant input u, (m,).

        Raises:
            PlantError: a state that must stay positive does not, or the numbers are not finite.
        """
        self._check(x)
        if dt <= 0.0:
            return np.array(x, dtype=float)
        after = self._in_one(x, u, dt)
        if after is None:
            after = self._in_many(x, u, dt)
        self._check(after)
        return after

    def _in_one(self, x: np.ndarray, u: np.ndarray, dt: float) -> np.ndarray | None:
        """One step of DOP853 over all of dt, where its own error estimate allows that; else None.

        At short periods it always does, and then this takes a twentieth of the time.
        """
        whole = self._whole
        whole.inputs["x"][:, 0], whole.inputs["u"][:, 0], whole.inputs["dt"][0, 0] = x, u, dt
        whole()
        # A stage outside the domain makes this NaN, which no comparison accepts.
        return whole.outputs["after"][:, 0].copy() if whole.outputs["error"][0, 0] < 1.0 else None

    def _in_many(self, x: np.ndarray, u: np.ndarray, dt: float) -> np.ndarray:
        self._f.inputs["u"][:, 0] = u
        solver = _method()(
            self._rhs,
            0.0,
            np.asarray(x, dtype=float),
            dt,
            rtol=INTEGRATION_TOLERANCE,
            atol=INTEGRATION_TOLERANCE * self.plant.x_scale,
        )
        while solver.status == "running":
            trouble = solver.step()
            if trouble:
                raise PlantError(
                    f"{self.plant.name}: the equations of motion cannot be integrated: {trouble}"
                )
        return solver.y

    def _rhs(self, _t: float, x: np.ndarray) -> np.ndarray:
        inside = self._f.inputs["x"][:, 0]
        inside[:] = x
        for domain in self.plant.positive:
            # A trial stage may leave the domain where the true motion does not; what is accepted is checked.
            inside[domain.state] = max(
                inside[domain.state], INTEGRATION_TOLERANCE * self.plant.x_scale[domain.state]
            )
        self._f()
        dx = self._f.outputs["dx"][:, 0]
        if not np.isfinite(dx).all():
            self._check(x)
            raise PlantError(f"{self.plant.name}: dx/dt is not finite at x = {x.tolist()}")
        return dx.copy()

    def _check(self, x: np.ndarray) -> None:
        values = x.tolist()
        for domain in self.plant.positive:
            value = values[domain.state]
            if not value > 0.0:
                raise PlantError(
                    f"{self.plant.name}: {domain.name} is {value:.6g} {domain.unit}; its equations hold for positive "
                    f"values only. The plant has left every state from which it can be controlled."
                )
        # Numbers that are all finite have a finite sum.
        if not isfinite(sum(values)):
            raise PlantError(f"{self.plant.name}: the state is not finite: {values}")


def _method() -> Any:
    """DOP853. Imported where it is used: that takes half a second, and a controller that died integrates nothing."""
    from scipy.integrate import DOP853

    return DOP853


class Stepped(NamedTuple):
    """One step of DOP853: x(dt) and the slopes at its stages."""

    after: ca.SX
    slopes: list[ca.SX]


def dop853(f: Callable[[ca.SX, ca.SX], ca.SX], x: ca.SX, u: ca.SX, dt: ca.SX | float) -> Stepped:
    """A single step of DOP853 along dx/dt = f(x, u), as one expression."""
    method, slopes = _method(), [f(x, u)]
    for weights in method.A[1 : method.n_stages]:
        slopes.append(f(x + dt * _weighted(weights, slopes), u))
    return Stepped(x + dt * _weighted(method.B, slopes), slopes)


def _whole_step(plant: Plant) -> ca.Function:
    """(x, u, dt) -> (x(dt) by a single step of DOP853, its error in units of what is tolerated).

    The same stages and the same estimate as scipy's, as one expression instead of hundreds of small numpy calls.
    """
    f, method = plant.function(), _method()
    x, u, dt = ca.SX.sym("x", plant.d), ca.SX.sym("u", plant.m), ca.SX.sym("dt")
    after, slopes = dop853(f, x, u, dt)
    slopes = [*slopes, f(after, u)]
    scale = INTEGRATION_TOLERANCE * (plant.x_scale + ca.fmax(ca.fabs(x), ca.fabs(after)))
    fifth, third = (ca.sumsqr(_weighted(weights, slopes) / scale) for weights in (method.E5, method.E3))
    bound = plant.d * (fifth + 0.01 * third)
    # Both estimates are exactly zero where nothing moves.
    error = ca.if_else(bound > 0, dt * fifth / ca.sqrt(bound), bound)
    return ca.Function("whole_step", [x, u, dt], [after, error], ["x", "u", "dt"], ["after", "error"])


def _weighted(weights: np.ndarray, slopes: list[ca.SX]) -> ca.SX:
    terms = [float(w) * slope for w, slope in zip(weights, slopes, strict=False) if w]
    return ca.sum2(ca.horzcat(*terms))
