"""Whether a plant can be used, numbers or equations. Every command looks before it begins."""

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
"""How far x_e and u_e may be from rest, as a share of the half-widths of X and U."""
FLAT = 1e-9
"""Half-widths a second that rounding may leave where the equations have no slope at rest."""
WRITE_IT = "Write the equations with CasADi's operations: ca.sin, not math.sin, and ca.if_else, not if"


def require_sound(plant: Known | Plant) -> None:
    """Raise `PlantDefinitionError` with all faults of this plant, if it has any."""
    refuse(plant.name, faults(plant), _where(plant))


def has_form(plant: Known | Plant) -> bool:
    """Whether names, shapes and numbers are right, and equations can be written down: whether it can be changed."""
    if name_faults(plant):
        return False
    found = form_faults(plant) if isinstance(plant, Known) else [*number_faults(plant), *_equations(plant)]
    return not found


def require_equations(plant: Known | Plant) -> None:
    """Raise `PlantDefinitionError` where the names or the equations cannot be used; it may rest nowhere."""
    found = name_faults(plant) or (
        tuple(_equations(plant)) if isinstance(plant, Plant) else known_faults(plant)
    )
    refuse(plant.name, found, _where(plant))


def require_model(plant: Known | Plant) -> None:
    """Raise `PlantDefinitionError` with the faults of what a model is made of: names, numbers, bounds and equations."""
    refuse(plant.name, name_faults(plant) or _faults_of_model(plant), _where(plant))


def faults(plant: Known | Plant) -> tuple[str, ...]:
    """Every fault of the description, one sentence each; empty where the plant can be used."""
    # Lengths and indices mean nothing without states and inputs.
    return name_faults(plant) or (*_faults_of_model(plant), *choice_faults(plant))


def _where(plant: Known | Plant) -> str:
    code = getattr(plant.rhs, "__code__", None) if isinstance(plant, Plant) else None
    return "" if code is None else f" (its equations: {code.co_filename}, line {code.co_firstlineno})"


@lru_cache(maxsize=16)
def _faults_of_model(plant: Known | Plant) -> tuple[str, ...]:
    """Remembered: a plant never changes, it is looked at wherever it is looked up, and derivatives take a while."""
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
    """Whether rhs can be written down in symbols, and has a finite value where it must."""
    x, u = ca.SX.sym("x", plant.d), ca.SX.sym("u", plant.m)
    try:
        slopes: Any = plant.rhs(x, u)
    except Exception as error:  # noqa: BLE001 - the equations are somebody else's code
        yield f"rhs fails{_at(plant, error)}: {type(error).__name__}: {_said(error)}. {WRITE_IT}"
        return
    if not isinstance(slopes, list | tuple | np.ndarray):
        yield f"rhs returns {slopes!r}: it must return a list, dx/dt of {', '.join(plant.states)} in this order"
        return
    try:
        f = plant.function()
    except Exception as error:  # noqa: BLE001 - CasADi raises what it likes for what it is given
        yield (
            f"rhs returns what CasADi cannot take: {_said(error)}. It must return one CasADi expression or number for "
            "each state, made of x and u alone"
        )
        return
    if f.size_out(0) != (plant.d, 1):
        yield (
            f"rhs returns {f.size_out(0)[0]} entries: it needs {plant.d}, dx/dt of {', '.join(plant.states)}, in this "
            "order"
        )


def _rest(plant: Plant) -> Iterator[str]:
    """Whether x_e is an equilibrium under u_e, and dx/dt a number there and at x0; all shapes are right."""
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
            "is made of them: take an equilibrium with a slope"
        )
        return
    # What moving x_e and u_e by this share of the half-widths would do.
    allowed = REST * (np.abs(a) @ plant.x_scale + np.abs(b) @ plant.u_scale) + FLAT * plant.x_scale
    moving = [
        f"d{plant.states[i]}/dt is {residual[i]:.3g} (of rounding, at most {allowed[i]:.1g})"
        for i in np.flatnonzero(np.abs(residual) > allowed)
    ]
    if moving:
        yield (
            f"(x_e, u_e) is not an equilibrium: {', '.join(moving)}. Give x_e and u_e at which the plant rests, with "
            f"more digits if need be{_nearest(plant)}"
        )
        return
    yield from mode_faults(a, b, None, plant)


def _nearest(plant: Plant) -> str:
    """Where it does rest, to be copied, or to be found by the plant itself."""
    try:
        rest = plant.resting_near()
    except PlantDefinitionError:
        return ""
    return (
        f". The nearest rest is {point(rest)}. Where something known moves it, "
        "wind or weight, let it be found: Plant(...).resting_near()"
    )


def _parameters(plant: Plant) -> Iterator[str]:
    """Whether the equations can be varied as the plant says; `rhs` itself is sound."""
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
    except Exception as error:  # noqa: BLE001 - the equations are somebody else's code
        failed = f"{type(error).__name__}: {_said(error)}"
        yield f"equations fails with symbols for {', '.join(parameters)}: {failed}. {WRITE_IT}"
        return
    given = np.array(f(plant.x0, plant.u_e)), np.array(varied(plant.x0, plant.u_e, list(parameters.values())))
    if not np.allclose(*given, rtol=1e-9, atol=1e-12):
        yield "rhs is not what equations makes of parameters: write rhs=equations(**parameters)"


def _at(plant: Plant, error: Exception) -> str:
    """The line of the plant's own file at which it failed."""
    code = getattr(plant.rhs, "__code__", None)
    frames = traceback.extract_tb(error.__traceback__)
    lines = [frame.lineno for frame in frames if code is not None and frame.filename == code.co_filename]
    return f" in line {lines[-1]}" if lines else ""


def _said(error: Exception) -> str:
    """Its last line, without the place in CasADi's own source."""
    lines = str(error).strip().splitlines() or [""]
    return re.sub(r"^\S+\.[ch]pp:\d+: ", "", lines[-1].strip()).rstrip(".")
