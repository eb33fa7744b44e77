"""The description of a plant without its motion: names, units, constraints, equilibrium and safe input."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Self

import numpy as np

from lbmpc.plants.rows import LinearRows, Row, no_rows, rows_of, together

STATE_VECTORS = ("x_e", "x_min", "x_max", "W", "x0")
INPUT_VECTORS = ("u_e", "u_min", "u_max", "safe_input")
HAIR = 1e-9
"""Share of a period. Two times that differ by less are equal."""
TUPLES = ("states", "inputs", "performance", "kernel", "poles")
EVERY: Any = None
"""Marks a field that was not set."""


class PlantError(ArithmeticError):
    """The plant's true motion cannot be computed any further. The text says why and where."""


class PlantDefinitionError(LookupError):
    """The plant cannot be used. The text names every fault, its field and the remedy."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Description:
    """A plant in its own units with its constraints and the equilibrium of its model.

    Shapes: d states, m inputs; `x_*` are (d,), `u_*` are (m,), `W` is (d,). Lists are accepted for arrays and tuples.
    The constructor checks nothing. `lbmpc.plants.get_plant` and `lbmpc.model.build_model` check the plant.
    """

    name: str
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    units: Mapping[str, str]
    """Units by the names of states, inputs and time ("t")."""
    x_e: np.ndarray
    """Equilibrium of the model."""
    u_e: np.ndarray
    x_min: np.ndarray
    """Bounds of X. An infinite bound is allowed if `scale` has this state. Likewise `u_min` and `u_max`."""
    x_max: np.ndarray
    u_min: np.ndarray
    u_max: np.ndarray
    W: np.ndarray
    """Half-widths of the disturbance box for constraint tightening, per second of sampling period."""
    x0: np.ndarray
    safe_input: np.ndarray
    """Input that the plant's own hardware applies without commands; with a `safe_gain`, its value at x_e."""
    performance: tuple[int, ...] = EVERY
    """States in the reported cost. The overshoot of the first one is reported. All states by default."""
    kernel: tuple[str, ...] = EVERY
    """States and inputs that are arguments of the L2NW kernel. All by default."""
    safe_gain: np.ndarray | None = None
    """Gain, (m, d), of the safe input safe_input + safe_gain (x - x_e), updated every period, for a plant that no
    constant input holds at x_e. With None the safe input is constant."""
    poles: tuple[complex, ...] | None = None
    """Continuous-time closed-loop poles for K; None for the LQR gain with the controller's Q and R."""
    scale: Mapping[str, float] = field(default_factory=dict)
    """Half-width that counts as 1, by name and in its unit, for a state or input without both bounds."""
    names: Mapping[str, str] = field(default_factory=dict)
    """Descriptive names of states and inputs, by name."""
    dead_time: float = 0.0
    """Seconds between writing an input and the plant's response, the same for all inputs: transport, a pipe, or a bus
    behind the gateway."""
    u_rate_max: np.ndarray | None = None
    """Rate limits of the inputs, (m,), per second; infinite for an input without one. None for no limits."""
    rows: Mapping[str, Row] = field(default_factory=dict)
    """Constraints in addition to the boxes, by name, of states or of inputs, such as
    {"surge": {"z": 1.0, "y": -0.5, "max": 0.3, "priority": 1}}. X and U are the intersections of boxes and rows."""

    def __post_init__(self) -> None:
        for name in (*STATE_VECTORS, *INPUT_VECTORS, "safe_gain", "u_rate_max"):
            object.__setattr__(self, name, as_array(getattr(self, name)))
        for name in TUPLES:
            object.__setattr__(self, name, as_tuple(getattr(self, name)))
        if isinstance(self.states, tuple) and isinstance(self.inputs, tuple):
            every = {"performance": tuple(range(self.d)), "kernel": (*self.states, *self.inputs)}
            for name, whole in every.items():
                if getattr(self, name) is EVERY:
                    object.__setattr__(self, name, whole)

    def changed(
        self,
        bounds: Mapping[str, Sequence[float | None]],
        x_e: Sequence[float] | None = None,
        u_e: Sequence[float] | None = None,
        dead_time: float | None = None,
        input_rate_max: Mapping[str, float] | None = None,
        rows: Mapping[str, Row] | None = None,
    ) -> Self:
        """Return the plant with other bounds, another equilibrium or other limits.

        Args:
            bounds: lower and upper bound by the name of a state or input; None for no bound.
            x_e, u_e: the equilibrium, (d,) and (m,), at which equations are linearised.
            dead_time: seconds; None keeps the plant's own.
            input_rate_max: rate limits per second by the name of the input.
            rows: constraints in addition to the boxes, by name.

        Entries that are not given stay as they are.

        Raises:
            KeyError: a bound's name is no state or input, or a rate's name is no input.
        """
        for name in bounds:
            if name not in (*self.states, *self.inputs):
                raise KeyError(name)
        new: dict[str, Any] = {
            name: value
            for name, value in (("x_e", x_e), ("u_e", u_e), ("dead_time", dead_time))
            if value is not None
        }
        for axis, names in (("x", self.states), ("u", self.inputs)):
            low, high = np.array(getattr(self, f"{axis}_min")), np.array(getattr(self, f"{axis}_max"))
            # An array with a wrong shape is reported when the plant is checked.
            if bounds and low.shape == high.shape == (len(names),):
                for name, (lower, upper) in bounds.items():
                    if name in names:
                        low[names.index(name)] = -np.inf if lower is None else lower
                        high[names.index(name)] = np.inf if upper is None else upper
                new |= {f"{axis}_min": low, f"{axis}_max": high}
        if input_rate_max:
            rates = self.input_rates.copy()
            for name, rate in input_rate_max.items():
                if name not in self.inputs:
                    raise KeyError(name)
                rates[self.inputs.index(name)] = rate
            new["u_rate_max"] = rates
        if rows:
            new["rows"] = {**self.rows, **rows}
        return replace(self, **new) if new else self

    def safe_input_at(self, x: np.ndarray) -> np.ndarray:
        """Return the input that the plant's own hardware applies at x, (d,), without commands, (m,); in U."""
        u = self.safe_input
        if self.safe_gain is not None:
            with np.errstate(over="ignore", invalid="ignore"):
                fed_back = u + self.safe_gain @ (x - self.x_e)
            u = fed_back if np.isfinite(fed_back).all() else u
        return self.within(u)

    def within(self, u: Sequence[float] | np.ndarray) -> np.ndarray:
        """Return an input in U near u, (m,): clipped to its bounds, then moved towards u_e until the rows hold."""
        return self.input_rows.pulled(np.minimum(np.maximum(u, self.u_min), self.u_max), self.u_e)

    def within_about(self, v: np.ndarray) -> np.ndarray:
        """Do the same as `within` in deviations from u_e, (m,)."""
        low, high, rows = self._inputs_about
        return rows.pulled(np.minimum(np.maximum(v, low), high), 0.0)

    def reachable(self, u: np.ndarray, previous: np.ndarray, period: float) -> np.ndarray:
        """Return the input nearest to u, (m,), within the rate limits one period after `previous`, (m,).

        Both are deviations or both are not. If U has rows besides its box, the result is on the line from `previous` to
        u, so that it satisfies them.
        """
        step = self.input_rates * period
        if self.input_rows.names:
            return together(u, previous, previous - step, previous + step)
        return np.minimum(np.maximum(u, previous - step), previous + step)

    def dead_periods(self, period: float) -> int:
        """Return the dead time in whole periods, rounded up."""
        return math.ceil(self.dead_time / period - HAIR)

    def beyond_x(self, x: np.ndarray) -> np.ndarray:
        """Return the violation of each bound of X in half-widths, negative inside: (..., d) -> (..., d + rows)."""
        boxes, rows = np.maximum(self.x_min - x, x - self.x_max) / self.x_scale, self.state_rows
        return np.concatenate([boxes, rows.beyond(x)], axis=-1) if rows.names else boxes

    @cached_property
    def x_names(self) -> tuple[str, ...]:
        """Names of the bounds of X, (d + rows,): states, then rows."""
        return (*self.states, *self.state_rows.names)

    @cached_property
    def state_rows(self) -> LinearRows:
        """Rows of X in addition to its box."""
        return rows_of(self.rows, self.states, self.x_scale) if self.rows else no_rows(self.d)

    @cached_property
    def input_rows(self) -> LinearRows:
        """Rows of U in addition to its box."""
        return rows_of(self.rows, self.inputs, self.u_scale) if self.rows else no_rows(self.m)

    @cached_property
    def _inputs_about(self) -> tuple[np.ndarray, np.ndarray, LinearRows]:
        """U in deviations from u_e: its box and its rows."""
        return self.u_min - self.u_e, self.u_max - self.u_e, self.input_rows.about(self.u_e)

    @property
    def d(self) -> int:
        return len(self.states)

    @property
    def m(self) -> int:
        return len(self.inputs)

    @cached_property
    def input_rates(self) -> np.ndarray:
        """`u_rate_max`, (m,), with infinity for no limit."""
        return np.full(self.m, np.inf) if self.u_rate_max is None else self.u_rate_max

    @cached_property
    def x_scale(self) -> np.ndarray:
        """Unit of each state, (d,): the half-width of X if it is finite, otherwise the entry of `scale`."""
        return self._half_widths(self.states, self.x_min, self.x_max)

    @cached_property
    def u_scale(self) -> np.ndarray:
        """Unit of each input, (m,), as for `x_scale`."""
        return self._half_widths(self.inputs, self.u_min, self.u_max)

    def _half_widths(self, names: tuple[str, ...], low: np.ndarray, high: np.ndarray) -> np.ndarray:
        with np.errstate(over="ignore"):
            half = 0.5 * (high - low)
        for i in np.flatnonzero(~np.isfinite(half)):
            half[i] = self.scale[names[i]]
        return half


def as_array(value: Any) -> Any:
    """Return numbers as an array. Other values are returned unchanged, and reported when the plant is checked."""
    try:
        return None if value is None else np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        return value


def as_tuple(value: Any) -> Any:
    """Return a list as a tuple and any other value unchanged."""
    return tuple(value) if isinstance(value, list) else value
