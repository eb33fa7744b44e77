"""The true motion of a plant: the interface `TrueMotion` and its implementations."""

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
    """The real motion of a plant. It is deterministic and keeps nothing between calls."""

    def step(self, x: np.ndarray, u: np.ndarray, dt: float) -> np.ndarray:
        """Return x(t + dt) from x(t) = x, (d,), under the constant input u, (m,); plant units, dt in seconds.

        Raises:
            PlantError: the motion cannot be computed.
        """
        ...


def true_motion(plant: Known | Plant | TrueMotion) -> TrueMotion:
    """Return the motion of this plant if no other truth is configured. A user's motion is returned checked."""
    if isinstance(plant, Known):
        return LinearTruth(plant)
    return Truth(plant) if isinstance(plant, Plant) else Own(plant)


class LinearTruth:
    """The true motion of a plant given by numbers: the linear model is exact and h is zero."""

    def __init__(self, known: Known):
        self._known = known
        units = balanced(known)
        self._within = None if known.period is None else within_period(known, known.period)
        # Only few lengths of time occur.
        self._over = lru_cache(maxsize=64)(lambda dt: discretise(known.A, known.B, dt, units))

    def step(self, x: np.ndarray, u: np.ndarray, dt: float) -> np.ndarray:
        """Step as `TrueMotion` does. Raises `PlantError` if the numbers are not finite."""
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
        """Raise `PlantError` if dt is no whole period of a straight line: two half steps would not equal one step."""
        within = self._within
        if not isinstance(within, StraightLine):
            return
        if not isclose(remainder(dt, within.period), 0.0, abs_tol=1e-6 * dt):
            raise PlantError(
                f"{self._known.name}: its A and B are in discrete time and give no motion between two samples. They "
                "cannot simulate an input that changes between samples, as it does with any delay. Set plant.truth to "
                "a plant with a motion in continuous time"
            )


class Own:
    """A user's motion. An exception from it, or a wrong result, ends the run with the cause."""

    def __init__(self, motion: TrueMotion):
        self._motion = motion
        self._name = type(motion).__name__

    def step(self, x: np.ndarray, u: np.ndarray, dt: float) -> np.ndarray:
        """Step as `TrueMotion.step` does."""
        if dt <= 0.0:
            return np.array(x, dtype=float)
        try:
            after = np.array(self._motion.step(np.array(x), np.array(u), dt), dtype=float)
        except Exception as error:
            raise PlantError(f"{self._name}.step: {type(error).__name__}: {error}") from error
        if after.shape != np.shape(x):
            raise PlantError(
                f"{self._name}.step: it returned an array of shape {after.shape}, but the state has {np.shape(x)}"
            )
        if not isfinite(sum(after.tolist())):
            raise PlantError(f"{self._name}.step: the state is not finite: {after.tolist()}")
        return after


class Truth:
    """The true motion of a plant given by equations.

    The local error is below 1e-9 half-widths over a sampling period. The method is DOP853 (order 8, scipy) with rtol =
    1e-12 and atol = 1e-12 half-widths. It is deterministic.
    """

    def __init__(self, plant: Plant):
        self.plant = plant
        self._f = Bound(plant.function())
        self._whole = Bound(_whole_step(plant))

    def step(self, x: np.ndarray, u: np.ndarray, dt: float) -> np.ndarray:
        """Return x(t + dt) from x(t) = x, (d,), under the constant input u, (m,).

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
        """Take one step of DOP853 over dt; None if its error estimate is too large.

        At short periods one step is always enough, and takes a twentieth of the time of scipy's loop.
        """
        whole = self._whole
        whole.inputs["x"][:, 0], whole.inputs["u"][:, 0], whole.inputs["dt"][0, 0] = x, u, dt
        whole()
        # A stage outside the domain gives NaN, for which every comparison is false.
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
            # A trial stage may leave the domain even if the true motion does not. The accepted result is checked.
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
                    f"values only. The plant cannot be controlled from this state."
                )
        # The sum of finite numbers is finite.
        if not isfinite(sum(values)):
            raise PlantError(f"{self.plant.name}: the state is not finite: {values}")


def _method() -> Any:
    """Return DOP853. The import takes half a second, which a restarted controller does not need."""
    from scipy.integrate import DOP853

    return DOP853


class Stepped(NamedTuple):
    """One step of DOP853: x(dt) and the derivatives at its stages."""

    after: ca.SX
    slopes: list[ca.SX]


def dop853(f: Callable[[ca.SX, ca.SX], ca.SX], x: ca.SX, u: ca.SX, dt: ca.SX | float) -> Stepped:
    """Return a single step of DOP853 along dx/dt = f(x, u) as one expression."""
    method, slopes = _method(), [f(x, u)]
    for weights in method.A[1 : method.n_stages]:
        slopes.append(f(x + dt * _weighted(weights, slopes), u))
    return Stepped(x + dt * _weighted(method.B, slopes), slopes)


def _whole_step(plant: Plant) -> ca.Function:
    """Build (x, u, dt) -> (x(dt) by a single step of DOP853, its error in units of the tolerance).

    Stages and error estimate equal scipy's, in one expression instead of hundreds of small numpy calls.
    """
    f, method = plant.function(), _method()
    x, u, dt = ca.SX.sym("x", plant.d), ca.SX.sym("u", plant.m), ca.SX.sym("dt")
    after, slopes = dop853(f, x, u, dt)
    slopes = [*slopes, f(after, u)]
    scale = INTEGRATION_TOLERANCE * (plant.x_scale + ca.fmax(ca.fabs(x), ca.fabs(after)))
    fifth, third = (ca.sumsqr(_weighted(weights, slopes) / scale) for weights in (method.E5, method.E3))
    bound = plant.d * (fifth + 0.01 * third)
    # Both estimates are exactly zero if nothing moves.
    error = ca.if_else(bound > 0, dt * fifth / ca.sqrt(bound), bound)
    return ca.Function("whole_step", [x, u, dt], [after, error], ["x", "u", "dt"], ["after", "error"])


def _weighted(weights: np.ndarray, slopes: list[ca.SX]) -> ca.SX:
    terms = [float(w) * slope for w, slope in zip(weights, slopes, strict=False) if w]
    return ca.sum2(ca.horzcat(*terms))
