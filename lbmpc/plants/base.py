"""What a plant is: its equations, its equilibrium, its constraints, and its true motion.

Bring your own plant as one file beside this one: give `rhs` in CasADi operations and fill in a `Plant`.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import isfinite
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from lbmpc.casadi_buffers import Bound

INTEGRATION_TOLERANCE = 1e-12
STATE_VECTORS = ("x_e", "x_min", "x_max", "W", "x0")
INPUT_VECTORS = ("u_e", "u_min", "u_max", "safe_input")
TUPLES = ("states", "inputs", "performance", "kernel", "poles", "positive")
Rhs = Callable[[Any, Any], list[Any]]


class PlantError(ArithmeticError):
    """The plant's true equations cannot be followed any further; the text says why and where."""


@dataclass(frozen=True)
class Domain:
    """A state that must stay positive for the equations to mean anything."""

    state: int
    name: str
    unit: str


@dataclass(frozen=True, eq=False)
class Plant:
    """A continuous-time plant dx/dt = f(x, u) with box constraints, in its own units.

    Shapes: d states, m inputs; `x_*` are (d,), `u_*` are (m,), `W` is (d,). Lists are accepted for arrays and tuples.
    Nothing is checked here: `lbmpc.plants.get_plant` and `lbmpc.model.build_model` refuse a plant that cannot be used.
    """

    name: str
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    units: dict[str, str]
    """Unit of every state, input and of time, by name."""
    rhs: Rhs
    """f(x, u) written with CasADi operations; x and u are indexable."""
    x_e: np.ndarray
    """Equilibrium about which the model is linearised."""
    u_e: np.ndarray
    x_min: np.ndarray
    """Bounds of X; infinite where there is none, and then `scale` has this state. As for `u_min` and `u_max`."""
    x_max: np.ndarray
    u_min: np.ndarray
    u_max: np.ndarray
    W: np.ndarray
    """Half-widths of the disturbance box used for tightening by default, per second of sampling period."""
    x0: np.ndarray
    safe_input: np.ndarray
    """What the plant's own hardware applies when nobody commands it, at x_e where there is a `safe_gain`."""
    performance: tuple[int, ...]
    """States that make up the reported cost; the first is the one whose overshoot is reported."""
    kernel: tuple[str, ...]
    """States and inputs that the L2NW kernel sees."""
    safe_gain: np.ndarray | None = None
    """(m, d): then that is safe_input + safe_gain (x - x_e), renewed every period; for a plant that no constant input
    holds at x_e. None: safe_input."""
    poles: tuple[complex, ...] | None = None
    """Continuous-time closed-loop poles for K; None: LQR with the controller's Q and R."""
    positive: tuple[Domain, ...] = ()
    scale: Mapping[str, float] = field(default_factory=dict)
    """By name, for a state or input that is not bounded on both sides: the half-width that counts as 1, in its unit."""
    names: Mapping[str, str] = field(default_factory=dict)
    """What states and inputs are called in a person's words, by name."""
    parameters: Mapping[str, float] = field(default_factory=dict)
    """What the equations are built with, by name; empty where they cannot be varied."""
    equations: Callable[..., Rhs] | None = None
    """`rhs` from `parameters`, given by name: numbers, or CasADi symbols."""

    def __post_init__(self) -> None:
        for name in (*STATE_VECTORS, *INPUT_VECTORS, "safe_gain"):
            object.__setattr__(self, name, _array(getattr(self, name)))
        for name in TUPLES:
            value = getattr(self, name)
            object.__setattr__(self, name, tuple(value) if isinstance(value, list) else value)

    def varied(self, **changes: float) -> Plant:
        """This plant with other parameters in its equations; all else, x_e and the bounds too, stays as it is.

        Raises:
            KeyError: there is no such parameter; names the nearest, or those there are.
            PlantError: with these parameters dx/dt is not finite at (x_e, u_e).
        """
        for name in changes:
            if self.equations is None or name not in self.parameters:
                near = difflib.get_close_matches(name, self.parameters, n=1)
                known = ", ".join(self.parameters) or "none that can be varied"
                hint = f"did you mean {near[0]!r}?" if near else f"it has {known}"
                raise KeyError(f"{self.name} has no parameter {name!r}; {hint}")
        if self.equations is None:
            return self
        parameters = {**self.parameters, **changes}
        varied = replace(self, parameters=parameters, rhs=self.equations(**parameters))
        if not np.isfinite(np.array(varied.function()(self.x_e, self.u_e))).all():
            given = ", ".join(f"{name} = {value:g}" for name, value in changes.items())
            raise PlantError(f"{self.name} with {given}: dx/dt is not finite at (x_e, u_e)")
        return varied

    @property
    def d(self) -> int:
        return len(self.states)

    @property
    def m(self) -> int:
        return len(self.inputs)

    @cached_property
    def x_scale(self) -> np.ndarray:
        """What counts as 1 in each state, (d,): X's half-width where it is finite, else what `scale` says."""
        return self._half_widths(self.states, self.x_min, self.x_max)

    @cached_property
    def u_scale(self) -> np.ndarray:
        """What counts as 1 in each input, (m,), as for `x_scale`."""
        return self._half_widths(self.inputs, self.u_min, self.u_max)

    def _half_widths(self, names: tuple[str, ...], low: np.ndarray, high: np.ndarray) -> np.ndarray:
        with np.errstate(over="ignore"):
            half = 0.5 * (high - low)
        for i in np.flatnonzero(~np.isfinite(half)):
            half[i] = self.scale[names[i]]
        return half

    def function(self) -> ca.Function:
        """f as a CasADi function (x, u) -> dx/dt."""
        x, u = ca.SX.sym("x", self.d), ca.SX.sym("u", self.m)
        return ca.Function("f", [x, u], [ca.vertcat(*self.rhs(x, u))], ["x", "u"], ["dx"])

    def function_of_parameters(self) -> ca.Function:
        """f as a CasADi function (x, u, p) -> dx/dt; p are the `parameters` in their order, (0,) where it has none."""
        x, u = ca.SX.sym("x", self.d), ca.SX.sym("u", self.m)
        p = ca.SX.sym("p", len(self.parameters))
        rhs = self.rhs
        if self.equations is not None:
            rhs = self.equations(**{name: p[i] for i, name in enumerate(self.parameters)})
        return ca.Function("f", [x, u, p], [ca.vertcat(*rhs(x, u))], ["x", "u", "p"], ["dx"])

    def linearised(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """dx/dt at (x_e, u_e), (d,), and its Jacobians there in x, (d, d), and in u, (d, m)."""
        f = self.function()
        x, u = ca.SX.sym("x", self.d), ca.SX.sym("u", self.m)
        dx = f(x, u)
        jacobian = ca.Function("jacobian", [x, u], [dx, ca.jacobian(dx, x), ca.jacobian(dx, u)])
        residual, a, b = (np.array(value) for value in jacobian(self.x_e, self.u_e))
        return residual[:, 0], a, b


def _array(value: Any) -> Any:
    """Numbers as an array; what are none stays as it is, for whoever looks at the plant to name."""
    try:
        return None if value is None else np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        return value


class Truth:
    """The plant's true motion, integrated to a local error below 1e-9 half-widths over a sampling period.

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
