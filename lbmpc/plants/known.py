"""A plant as the controller knows it: numbers without equations. They fit into a log, and a replay needs no more."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from lbmpc.plants.description import Description, as_array, as_tuple
from lbmpc.plants.faults import (
    bound_faults,
    choice_faults,
    name_faults,
    number_faults,
    pole_faults,
    refuse,
    require_held,
    unusable,
)
from lbmpc.plants.matrices import matrix_faults, mode_faults, pair_faults
from lbmpc.plants.rest import nearest_rest
from lbmpc.plants.rows import Row
from lbmpc.plants.written import read, written

ROUNDING = 1e-12
"""Half-widths. A point this close to a rest is not moved at all."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Known(Description):
    """A linear model in deviations from (x_e, u_e), at which the plant rests.

    In continuous time dx/dt = A x + B u. In discrete time x+ = A x + B u after every `period`, with u constant.
    """

    A: np.ndarray
    """(d, d)"""
    B: np.ndarray
    """(d, m)"""
    period: float | None = None
    """Seconds between two states of a discrete-time model; None for continuous time."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("A", "B"):
            object.__setattr__(self, name, as_array(getattr(self, name)))

    def varied(self, **changes: float) -> Known:
        """Return the plant itself, because it has no parameters. Raises `KeyError` if a change is requested."""
        if changes:
            raise KeyError(
                f"{self.name} has no parameter {min(changes)!r}: it is given by numbers, without equations"
            )
        return self

    def resting_near(self, x_e: Any = None, u_e: Any = None) -> Known:
        """Return the model at the rest nearest to (x_e, u_e), by default its own.

        Raises:
            PlantDefinitionError: the model has no rest, or only one outside X or U.
        """
        x_e = self.x_e if x_e is None else np.asarray(x_e, dtype=float)
        u_e = self.u_e if u_e is None else np.asarray(u_e, dtype=float)
        return _at_rest(self, x_e, u_e, self.slope_x @ (x_e - self.x_e) + self.B @ (u_e - self.u_e))

    def changed(
        self,
        bounds: Mapping[str, Sequence[float | None]],
        x_e: Sequence[float] | None = None,
        u_e: Sequence[float] | None = None,
        dead_time: float | None = None,
        input_rate_max: Mapping[str, float] | None = None,
        rows: Mapping[str, Row] | None = None,
    ) -> Known:
        """Do the same as `Description.changed`; u_e is found for x_e. Raises `PlantDefinitionError` without a rest."""
        there = super().changed(bounds, x_e, u_e, dead_time, input_rate_max, rows)
        if x_e is None and u_e is None:
            return there
        refuse(self.name, all_faults(there))
        rest = replace(there, x_e=self.x_e, u_e=self.u_e).resting_near(there.x_e, there.u_e)
        require_held(there, rest, u_e is not None)
        return there if u_e is not None else rest

    def to_builtins(self) -> dict[str, Any]:
        """Return JSON-compatible data from which `from_builtins` restores the plant exactly; infinities are text."""
        return written({one.name: getattr(self, one.name) for one in fields(self)})

    @classmethod
    def from_builtins(cls, data: object) -> Known:
        """Restore a plant. Raises `PlantDefinitionError` for other data or an unusable plant."""
        known = cls(**read(data))
        refuse(known.name, all_faults(known))
        return known

    @property
    def slope_x(self) -> np.ndarray:
        """Derivative of the motion in x, (d, d): A for dx/dt, A - I for x+ - x."""
        return self.A if self.period is None else self.A - np.eye(self.d)

    @classmethod
    def from_matrices(
        cls,
        A: Any,
        B: Any,
        *,
        period: float | None = None,
        W: Any = None,
        offset: Any = None,
        name: str = "plant",
        states: Sequence[str] | None = None,
        inputs: Sequence[str] | None = None,
        units: Mapping[str, str] | None = None,
        x_e: Any = None,
        u_e: Any = None,
        x_min: Any = None,
        x_max: Any = None,
        u_min: Any = None,
        u_max: Any = None,
        u_rate_max: Any = None,
        x0: Any = None,
        safe_input: Any = None,
        safe_gain: Any = None,
        performance: Sequence[int] | None = None,
        kernel: Sequence[str] | None = None,
        poles: Sequence[complex] | None = None,
        scale: Mapping[str, float] | None = None,
        names: Mapping[str, str] | None = None,
        dead_time: float = 0.0,
        rows: Mapping[str, Row] | None = None,
    ) -> Known:
        """Return a plant given by a pair of matrices.

        Args:
            A, B: (d, d) and (d, m): dx/dt = A x + B u in deviations from (x_e, u_e); with a period, x+ = A x + B u.
            period: T in seconds of a discrete-time model, which can be used at the rate 1 / T only; None for continuous
                time.
            W: half-widths of the model error, per second, (d,). It has no default.
            offset: dx/dt, or x+ - x, at (x_e, u_e), (d,): a known bias. (x_e, u_e) is then moved to the nearest rest.
            name: name of the plant.
            states, inputs: their names; x1, x2, .. and u1, u2, .. by default.
            units: units by name; '1' by default, and 's' for time.
            x_e, u_e: the equilibrium; zeros by default.
            x_min, x_max, u_min, u_max: the bounds; none by default. `scale` is then required.
            x0: initial state of a simulation; x_e by default.
            safe_input: the safe input; u_e by default.
            performance: all states by default.
            kernel: all states and inputs by default.
            safe_gain, poles, scale, names, dead_time, u_rate_max, rows: see the fields of these names.

        Raises:
            PlantDefinitionError: the plant cannot be used. The text names every fault.
        """
        A, B = as_array(A), as_array(B)
        refuse(name, pair_faults(A, B))
        states = tuple(f"x{i + 1}" for i in range(len(A))) if states is None else as_tuple(states)
        inputs = tuple(f"u{i + 1}" for i in range(B.shape[1])) if inputs is None else as_tuple(inputs)
        zeros, none = np.zeros(len(states)), np.zeros(len(inputs))
        x_e, u_e = zeros if x_e is None else x_e, none if u_e is None else u_e
        known = cls(
            name=name,
            states=states,
            inputs=inputs,
            units={**dict.fromkeys((*states, *inputs), "1"), "t": "s", **(units or {})},
            x_e=x_e,
            u_e=u_e,
            x_min=zeros - np.inf if x_min is None else x_min,
            x_max=zeros + np.inf if x_max is None else x_max,
            u_min=none - np.inf if u_min is None else u_min,
            u_max=none + np.inf if u_max is None else u_max,
            W=W,
            x0=x_e if x0 is None else x0,
            safe_input=u_e if safe_input is None else safe_input,
            safe_gain=safe_gain,
            performance=as_tuple(performance),
            kernel=as_tuple(kernel),
            poles=None if poles is None else as_tuple(poles),
            scale=scale or {},
            names=names or {},
            dead_time=dead_time,
            u_rate_max=u_rate_max,
            rows=rows or {},
            A=A,
            B=B,
            period=period,
        )
        refuse(known.name, all_faults(known))
        if offset is None:
            return known
        found = _at_rest(known, known.x_e, known.u_e, _offset(known, offset))
        return replace(
            found,
            x0=found.x_e if x0 is None else found.x0,
            safe_input=found.u_e if safe_input is None else found.safe_input,
        )


def all_faults(known: Known) -> tuple[str, ...]:
    """Return every fault as a sentence; empty if the plant can be used."""
    # Without valid names of states and inputs, lengths and indices have no meaning.
    return name_faults(known) or (*known_faults(known), *choice_faults(known))


def known_faults(known: Known) -> tuple[str, ...]:
    """Return the faults in the numbers of the model. Names are valid here."""
    found = form_faults(known) or [*bound_faults(known), *pole_faults(known)]
    return tuple(found or mode_faults(known.A, known.B, known.period, known))


def form_faults(known: Known) -> list[str]:
    """Return the faults in shapes and in values that are not numbers."""
    matrices = matrix_faults(known.A, known.B, known.period, known.states, known.inputs)
    return [*number_faults(known), *matrices]


def _offset(known: Known, offset: Any) -> np.ndarray:
    drift = as_array(offset)
    if not (isinstance(drift, np.ndarray) and drift.shape == (known.d,) and np.isfinite(drift).all()):
        names = ", ".join(known.states)
        text = f"offset is {offset!r}: it needs {known.d} finite numbers, one for each of {names}"
        raise unusable(known.name, text)
    return np.asarray(drift)


def _at_rest(known: Known, x_e: np.ndarray, u_e: np.ndarray, drift: np.ndarray) -> Known:
    """Return the model at the rest nearest to (x_e, u_e), at which it has the given drift."""
    rounding = ROUNDING * (np.abs(known.slope_x) @ known.x_scale + np.abs(known.B) @ known.u_scale)
    if (np.abs(drift) > rounding).any():
        moved = nearest_rest(known.slope_x, known.B, drift, known.x_scale, known.u_scale, known.performance)
        if moved is None:
            text = f"at x_e = {x_e.tolist()} it drifts by {drift.tolist()}, and no input holds it there or nearby"
            raise unusable(known.name, text)
        x_e, u_e = x_e + moved[0], u_e + moved[1]
    found = replace(known, x_e=x_e, u_e=u_e)
    refuse(found.name, tuple(bound_faults(found)), " at the nearest rest")
    return found
