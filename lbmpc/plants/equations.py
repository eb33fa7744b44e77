"""A plant given by its equations dx/dt = f(x, u), for simulation and as the source of the model's numbers.

To add your own plant, write one file with `rhs` in CasADi operations and a `Plant`.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import casadi as ca
import numpy as np

from lbmpc.plants.description import Description, PlantError, as_tuple
from lbmpc.plants.faults import (
    bound_faults,
    choice_faults,
    name_faults,
    number_faults,
    refuse,
    require_held,
    unusable,
)
from lbmpc.plants.known import Known
from lbmpc.plants.rest import nearest_rest
from lbmpc.plants.rows import Row

Rhs = Callable[[Any, Any], list[Any]]
ROUNDS, STILL = 50, 1e-11
"""Iterations of Newton's method for a rest, and the step in half-widths at which it stops."""


@dataclass(frozen=True)
class Domain:
    """A state that must stay positive for the equations to be valid."""

    state: int
    name: str
    unit: str


@dataclass(frozen=True, eq=False, kw_only=True)
class Plant(Description):
    """A continuous-time plant dx/dt = f(x, u)."""

    rhs: Rhs
    """f(x, u) written with CasADi operations; x and u are indexable."""
    positive: tuple[Domain, ...] = ()
    parameters: Mapping[str, float] = field(default_factory=dict)
    """Parameters of the equations, by name; empty if they cannot be varied."""
    equations: Callable[..., Rhs] | None = None
    """Builds `rhs` from `parameters`, given by name as numbers or CasADi symbols."""

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "positive", as_tuple(self.positive))

    def changed(
        self,
        bounds: Mapping[str, Sequence[float | None]],
        x_e: Sequence[float] | None = None,
        u_e: Sequence[float] | None = None,
        dead_time: float | None = None,
        input_rate_max: Mapping[str, float] | None = None,
        rows: Mapping[str, Row] | None = None,
    ) -> Plant:
        """Do the same as `Description.changed`; u_e is found for x_e. Raises `PlantDefinitionError` without a rest."""
        there = super().changed(bounds, x_e, u_e, dead_time, input_rate_max, rows)
        if x_e is None or u_e is not None:
            return there
        rest = there.resting_near()
        require_held(there, rest, input_too=False)
        return rest

    def known(self) -> Known:
        """Return the numbers of the plant: the linearisation at (x_e, u_e) and the fields of its description."""
        shared = {one.name: getattr(self, one.name) for one in fields(Description)}
        _rest, a, b = self.linearised()
        return Known(**shared, A=a, B=b)

    def varied(self, **changes: float) -> Plant:
        """Return this plant with other parameters in its equations; x_e, bounds and other fields stay unchanged.

        Raises:
            KeyError: there is no such parameter. The text names the nearest one or lists them.
            PlantError: dx/dt is not finite at (x_e, u_e) with these parameters.
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

    def function(self) -> ca.Function:
        """Return f as a CasADi function (x, u) -> dx/dt."""
        x, u = ca.SX.sym("x", self.d), ca.SX.sym("u", self.m)
        return ca.Function("f", [x, u], [ca.vertcat(*self.rhs(x, u))], ["x", "u"], ["dx"])

    def function_of_parameters(self) -> ca.Function:
        """Return f as a CasADi function (x, u, p) -> dx/dt; p is `parameters` in order, (0,) without parameters."""
        x, u = ca.SX.sym("x", self.d), ca.SX.sym("u", self.m)
        p = ca.SX.sym("p", len(self.parameters))
        rhs = self.rhs
        if self.equations is not None:
            rhs = self.equations(**{name: p[i] for i, name in enumerate(self.parameters)})
        return ca.Function("f", [x, u, p], [ca.vertcat(*rhs(x, u))], ["x", "u", "p"], ["dx"])

    def linearised(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return dx/dt at (x_e, u_e), (d,), and its Jacobians in x, (d, d), and in u, (d, m)."""
        return _values(self._slopes(), self.x_e, self.u_e)

    def resting_near(self, x_e: Any = None, u_e: Any = None) -> Plant:
        """Return the plant at the rest nearest to (x_e, u_e), by default its own; see `nearest_rest`.

        Use it for a plant under a known load, such as wind or weight: x_e is the desired state and u_e is a guess.

        Raises:
            PlantDefinitionError: there is no rest nearby, or it lies outside X or U.
        """
        refuse(
            self.name,
            name_faults(self) or tuple(number_faults(self)) or (*bound_faults(self), *choice_faults(self)),
        )
        near_x = self.x_e if x_e is None else np.asarray(x_e, dtype=float)
        near_u = self.u_e if u_e is None else np.asarray(u_e, dtype=float)
        slopes, x, u = self._slopes(), near_x, near_u
        for _ in range(ROUNDS):
            residual, a, b = _values(slopes, x, u)
            if not all(np.isfinite(values).all() for values in (residual, a, b)):
                break
            drift = residual + a @ (near_x - x) + b @ (near_u - u)
            moved = nearest_rest(a, b, drift, self.x_scale, self.u_scale, self.performance)
            if moved is None:
                break
            last, x, u = (x, u), near_x + moved[0], near_u + moved[1]
            steps = np.concatenate([(x - last[0]) / self.x_scale, (u - last[1]) / self.u_scale])
            if np.abs(steps).max() <= STILL:
                found = replace(self, x_e=x, u_e=u)
                refuse(self.name, tuple(bound_faults(found)), " at the nearest rest")
                return found
        where = f"x_e = {near_x.tolist()}, u_e = {near_u.tolist()}"
        raise unusable(self.name, f"it rests nowhere near {where}")

    def _slopes(self) -> ca.Function:
        x, u = ca.SX.sym("x", self.d), ca.SX.sym("u", self.m)
        dx = self.function()(x, u)
        return ca.Function("slopes", [x, u], [dx, ca.jacobian(dx, x), ca.jacobian(dx, u)])


def _values(slopes: ca.Function, x: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    residual, a, b = (np.array(value) for value in slopes(x, u))
    return residual[:, 0], a, b
