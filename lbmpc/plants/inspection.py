"""Checks whether a plant, given by numbers or equations, can be used. Every command checks its plant first."""

from __future__ import annotations

import re
import traceback
from collections.abc import Iterator, Mapping
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from lbmpc.plants.description import PlantDefinitionError
from lbmpc.plants.equations import Domain, Plant
from lbmpc.plants.faults import (
    bound_faults,
    choice_faults,
    indices,
    is_index,
    name_faults,
    number_faults,
    point,
    pole_faults,
    refuse,
)
from lbmpc.plants.known import Known, form_faults, known_faults
from lbmpc.plants.matrices import mode_faults

REST = 1e-5
"""Largest distance of x_e and u_e from rest, as a share of the half-widths of X and U."""
FLAT = 1e-9
"""Rounding error in half-widths per second that is allowed where the equations have no slope at rest."""
WRITE_IT = "Write the equations with CasADi's operations: ca.sin, not math.sin, and ca.if_else, not if"


def require_sound(plant: Known | Plant) -> None:
    """Raise `PlantDefinitionError` with all faults of this plant, if it has any."""
    refuse(plant.name, faults(plant), _where(plant))


def has_form(plant: Known | Plant) -> bool:
    """Return whether names, shapes, numbers and equations are valid, so that the plant can be changed."""
    if name_faults(plant):
        return False
    found = form_faults(plant) if isinstance(plant, Known) else [*number_faults(plant), *_equations(plant)]
    return not found


def require_equations(plant: Known | Plant) -> None:
    """Raise `PlantDefinitionError` if names or equations are not usable. An equilibrium is not required."""
    found = name_faults(plant) or (
        tuple(_equations(plant)) if isinstance(plant, Plant) else known_faults(plant)
    )
    refuse(plant.name, found, _where(plant))


def require_model(plant: Known | Plant) -> None:
    """Raise `PlantDefinitionError` with the faults in names, numbers, bounds and equations of the model."""
    refuse(plant.name, name_faults(plant) or _faults_of_model(plant), _where(plant))


def faults(plant: Known | Plant) -> tuple[str, ...]:
    """Return every fault of the description as a sentence; empty if the plant can be used."""
    # Without valid names of states and inputs, lengths and indices have no meaning.
    return name_faults(plant) or (*_faults_of_model(plant), *choice_faults(plant))


def _where(plant: Known | Plant) -> str:
    code = getattr(plant.rhs, "__code__", None) if isinstance(plant, Plant) else None
    return "" if code is None else f" (its equations: {code.co_filename}, line {code.co_firstlineno})"


@lru_cache(maxsize=16)
def _faults_of_model(plant: Known | Plant) -> tuple[str, ...]:
    """The result is cached: a plant does not change, it is checked at every look-up, and derivatives take time."""
    if isinstance(plant, Known):
        return known_faults(plant)
    numbers = list(number_faults(plant))
    found = [*(numbers or [*bound_faults(plant), *_domains(plant), *pole_faults(plant)]), *_equations(plant)]
    return tuple(found or list(_rest(plant)) or _parameters(plant))


def _domains(plant: Plant) -> Iterator[str]:
    for domain in plant.positive:
        if not isinstance(domain, Domain):
            yield f"positive has {domain!r}: give Domain(state, name, unit)"
            continue
        if not is_index(domain.state, plant.d):
            yield f"positive: {domain.name} names state {domain.state!r}: {indices(plant)}"
            continue
        for field in ("x_e", "x0"):
            value = getattr(plant, field)[domain.state]
            if not value > 0.0:
                yield f"{field} of {plant.states[domain.state]} is {value:g}: {domain.name} must be positive there"


def _equations(plant: Plant) -> Iterator[str]:
    """Check that rhs can be written in symbols and has finite values where required."""
    x, u = ca.SX.sym("x", plant.d), ca.SX.sym("u", plant.m)
    try:
        slopes: Any = plant.rhs(x, u)
    except Exception as error:  # noqa: BLE001 - the equations are the user's code
        yield f"rhs fails{_at(plant, error)}: {type(error).__name__}: {_said(error)}. {WRITE_IT}"
        return
    if not isinstance(slopes, list | tuple | np.ndarray):
        yield f"rhs returns {slopes!r}: it must return a list, dx/dt of {', '.join(plant.states)} in this order"
        return
    try:
        f = plant.function()
    except Exception as error:  # noqa: BLE001 - CasADi raises various exceptions for bad arguments
        yield (
            f"CasADi cannot use the result of rhs: {_said(error)}. It must return one CasADi expression or number for "
            "each state, made of x and u alone"
        )
        return
    if f.size_out(0) != (plant.d, 1):
        yield (
            f"rhs returns {f.size_out(0)[0]} entries: it needs {plant.d}, dx/dt of {', '.join(plant.states)}, in this "
            "order"
        )


def _rest(plant: Plant) -> Iterator[str]:
    """Check that x_e is an equilibrium under u_e and that dx/dt is finite there and at x0. Shapes are valid here."""
    residual, a, b = plant.linearised()
    start = np.array(plant.function()(plant.x0, plant.u_e))[:, 0]
    for where, values in (("(x_e, u_e)", residual), ("x0", start)):
        unusable = [f"d{plant.states[i]}/dt is {values[i]:g}" for i in np.flatnonzero(~np.isfinite(values))]
        if unusable:
            yield f"{', '.join(unusable)} at {where}. {WRITE_IT}, and give a point at which the equations hold"
            return
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        yield (
            f"the slopes of dx/dt are not finite at (x_e, u_e): {a.tolist()} in x, {b.tolist()} in u. The model "
            "consists of them: use an equilibrium with finite slopes"
        )
        return
    # Effect of moving x_e and u_e by this share of the half-widths.
    allowed = REST * (np.abs(a) @ plant.x_scale + np.abs(b) @ plant.u_scale) + FLAT * plant.x_scale
    moving = [
        f"d{plant.states[i]}/dt is {residual[i]:.3g} (at most {allowed[i]:.1g} is rounding)"
        for i in np.flatnonzero(np.abs(residual) > allowed)
    ]
    if moving:
        yield (
            f"(x_e, u_e) is not an equilibrium: {', '.join(moving)}. Give x_e and u_e at which the plant rests, with "
            f"more digits if necessary{_nearest(plant)}"
        )
        return
    yield from mode_faults(a, b, None, plant)


def _nearest(plant: Plant) -> str:
    """Return a hint with the nearest rest, and with the method that finds it."""
    try:
        rest = plant.resting_near()
    except PlantDefinitionError:
        return ""
    return (
        f". The nearest rest is {point(rest)}. If a known load moves the plant, "
        "such as wind or weight, find it with Plant(...).resting_near()"
    )


def _parameters(plant: Plant) -> Iterator[str]:
    """Check that the equations can be varied as described. `rhs` itself is valid here."""
    parameters: Any = plant.parameters
    if not isinstance(parameters, Mapping) or not all(
        isinstance(v, int | float) for v in parameters.values()
    ):
        yield f"parameters is {parameters!r}: give numbers by name, as in {{'mass': 1.0}}"
        return
    if plant.equations is None:
        if parameters:
            yield f"parameters has {', '.join(parameters)} and equations is None: give the function that takes them"
        return
    try:
        f, varied = plant.function(), plant.function_of_parameters()
    except Exception as error:  # noqa: BLE001 - the equations are the user's code
        failed = f"{type(error).__name__}: {_said(error)}"
        yield f"equations fails with symbols for {', '.join(parameters)}: {failed}. {WRITE_IT}"
        return
    given = np.array(f(plant.x0, plant.u_e)), np.array(varied(plant.x0, plant.u_e, list(parameters.values())))
    if not np.allclose(*given, rtol=1e-9, atol=1e-12):
        yield "rhs is not what equations makes of parameters: write rhs=equations(**parameters)"


def _at(plant: Plant, error: Exception) -> str:
    """Return the line of the plant's own file at which the error was raised."""
    code = getattr(plant.rhs, "__code__", None)
    frames = traceback.extract_tb(error.__traceback__)
    lines = [frame.lineno for frame in frames if code is not None and frame.filename == code.co_filename]
    return f" in line {lines[-1]}" if lines else ""


def _said(error: Exception) -> str:
    """Return the last line of the error without the position in CasADi's source."""
    lines = str(error).strip().splitlines() or [""]
    return re.sub(r"^\S+\.[ch]pp:\d+: ", "", lines[-1].strip()).rstrip(".")
