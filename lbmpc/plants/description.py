"""What everybody knows of a plant: names, units, constraints, where it rests, what is safe. No motion yet."""

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
"""Of a period: two moments that are so near are one."""
TUPLES = ("states", "inputs", "performance", "kernel", "poles")
EVERY: Any = None
"""What nobody chose."""


class PlantError(ArithmeticError):
    """The plant's true motion cannot be followed any further; the text says why and where."""


class PlantDefinitionError(LookupError):
    """A plant is there and cannot be used; the text names every fault, its field and the remedy."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Description:
    """A plant in its own units, with constraints, about a point at which it rests.

    Shapes: d states, m inputs; `x_*` are (d,), `u_*` are (m,), `W` is (d,). Lists are accepted for arrays and tuples.
    Nothing is checked here: `lbmpc.plants.get_plant` and `lbmpc.model.build_model` refuse a plant that cannot be used.
    """

    name: str
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    units: Mapping[str, str]
    """Unit of every state, input and of time, by name."""
    x_e: np.ndarray
    """Equilibrium about which the model is linear."""
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
    performance: tuple[int, ...] = EVERY
    """States that make up the reported cost; the first is the one whose overshoot is reported. All by default."""
    kernel: tuple[str, ...] = EVERY
    """States and inputs that the L2NW kernel sees. All by default."""
    safe_gain: np.ndarray | None = None
    """(m, d): then that is safe_input + safe_gain (x - x_e), renewed every period; for a plant that no constant input
    holds at x_e. None: safe_input."""
    poles: tuple[complex, ...] | None = None
    """Continuous-time closed-loop poles for K; None: LQR with the controller's Q and R."""
    scale: Mapping[str, float] = field(default_factory=dict)
    """By name, for a state or input that is not bounded on both sides: the half-width that counts as 1, in its unit."""
    names: Mapping[str, str] = field(default_factory=dict)
    """What states and inputs are called in a person's words, by name."""
    dead_time: float = 0.0
    """Seconds from when an input is written until the plant begins to answer: transport, a pipe, a bus behind the
    gateway. Of all inputs."""
    u_rate_max: np.ndarray | None = None
    """How fast an input may change, (m,), per second, infinite where it may step; None: every input may."""
    rows: Mapping[str, Row] = field(default_factory=dict)
    """Constraints beside these boxes, by name, as {"surge": {"z": 1.0, "y": -0.5, "max": 0.3, "priority": 1}}: of
    states, or of inputs. X and U are then what keeps boxes and rows."""

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
        """With other bounds, or about another point.

        Args:
            bounds: lower and upper by the name of a state or input, None where there is none; others stay.
            x_e, u_e: (d,) and (m,), where equations are linearised.
            dead_time: seconds; None: its own.
            input_rate_max: how fast an input may change, per second, by its name; others stay.
            rows: beside the boxes, by name; others stay.

        Raises:
            KeyError: a bound of what is no state or input, a rate of what is no input.
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
            # What has another shape is for whoever looks at the plant to name.
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
        """What the plant's own hardware applies at x, (d,), when nobody commands it, (m,); inside U."""
        u = self.safe_input
        if self.safe_gain is not None:
            with np.errstate(over="ignore", invalid="ignore"):
                fed_back = u + self.safe_gain @ (x - self.x_e)
            u = fed_back if np.isfinite(fed_back).all() else u
        return self.within(u)

    def within(self, u: Sequence[float] | np.ndarray) -> np.ndarray:
        """An input of U near u, (m,): each in its bounds, and then as far to u_e as the rows need; u itself in U."""
        return self.input_rows.pulled(np.minimum(np.maximum(u, self.u_min), self.u_max), self.u_e)

    def within_about(self, v: np.ndarray) -> np.ndarray:
        """As `within`, in deviations from u_e, (m,)."""
        low, high, rows = self._inputs_about
        return rows.pulled(np.minimum(np.maximum(v, low), high), 0.0)

    def reachable(self, u: np.ndarray, previous: np.ndarray, period: float) -> np.ndarray:
        """The input nearest to u, (m,), that rate limits allow one period after `previous`, (m,); deviations or not.

        Where U has rows beside its box, that on the straight way from there, which keeps them.
        """
        step = self.input_rates * period
        if self.input_rows.names:
            return together(u, previous, previous - step, previous + step)
        return np.minimum(np.maximum(u, previous - step), previous + step)

    def dead_periods(self, period: float) -> int:
        """The dead time in whole periods, the last one begun."""
        return math.ceil(self.dead_time / period - HAIR)

    def beyond_x(self, x: np.ndarray) -> np.ndarray:
        """How far x is beyond each bound of X, in half-widths, negative inside: (..., d) -> (..., d + rows)."""
        boxes, rows = np.maximum(self.x_min - x, x - self.x_max) / self.x_scale, self.state_rows
        return np.concatenate([boxes, rows.beyond(x)], axis=-1) if rows.names else boxes

    @cached_property
    def x_names(self) -> tuple[str, ...]:
        """Of the bounds of X, (d + rows,): states, then rows."""
        return (*self.states, *self.state_rows.names)

    @cached_property
    def state_rows(self) -> LinearRows:
        """Of X, beside its box."""
        return rows_of(self.rows, self.states, self.x_scale) if self.rows else no_rows(self.d)

    @cached_property
    def input_rows(self) -> LinearRows:
        """Of U, beside its box."""
        return rows_of(self.rows, self.inputs, self.u_scale) if self.rows else no_rows(self.m)

    @cached_property
    def _inputs_about(self) -> tuple[np.ndarray, np.ndarray, LinearRows]:
        """U about u_e: its box, and the rows beside it."""
        return self.u_min - self.u_e, self.u_max - self.u_e, self.input_rows.about(self.u_e)

    @property
    def d(self) -> int:
        return len(self.states)

    @property
    def m(self) -> int:
        return len(self.inputs)

    @cached_property
    def input_rates(self) -> np.ndarray:
        """`u_rate_max`, (m,), infinite where there is no limit."""
        return np.full(self.m, np.inf) if self.u_rate_max is None else self.u_rate_max

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


def as_array(value: Any) -> Any:
    """Numbers as an array; what are none stays as it is, for whoever looks at the plant to name."""
    try:
        return None if value is None else np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        return value


def as_tuple(value: Any) -> Any:
    """A list as a tuple; all else stays as it is."""
    return tuple(value) if isinstance(value, list) else value
