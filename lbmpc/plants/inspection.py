"""What is wrong with a plant's description, in a person's words. Every command looks before it begins."""

from __future__ import annotations

import re
import traceback
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from lbmpc.plants.description import INPUT_VECTORS, STATE_VECTORS, Description, PlantDefinitionError
from lbmpc.plants.equations import Domain, Plant
from lbmpc.plants.known import Known

REST = 1e-5
"""How far x_e and u_e may be from rest, as a share of the half-widths of X and U."""
FLAT = 1e-9
"""Half-widths a second that rounding may leave where the equations have no slope at rest."""
WRITE_IT = "Write the equations with CasADi's operations: ca.sin, not math.sin, and ca.if_else, not if"
TIME = "t"
"""The name of time in a plant's units."""


def require_sound(plant: Known | Plant) -> None:
    """Raise `PlantDefinitionError` with all faults of this plant, if it has any."""
    _refuse(plant, faults(plant))


def require_names(plant: Known | Plant) -> None:
    """Raise `PlantDefinitionError` with what is wrong with the names, without which nothing else can be said."""
    _refuse(plant, _names(plant))


def require_model(plant: Known | Plant) -> None:
    """Raise `PlantDefinitionError` with the faults of what a model is made of: names, numbers, bounds and equations."""
    _refuse(plant, _names(plant) or _faults_of_model(plant))


def faults(plant: Known | Plant) -> tuple[str, ...]:
    """Every fault of the description, one sentence each; empty where the plant can be used."""
    # Lengths and indices mean nothing without states and inputs.
    return _names(plant) or (*_faults_of_model(plant), *_choices(plant))


def _refuse(plant: Known | Plant, found: tuple[str, ...]) -> None:
    if not found:
        return
    code = getattr(plant.rhs, "__code__", None) if isinstance(plant, Plant) else None
    where = "" if code is None else f" (its equations: {code.co_filename}, line {code.co_firstlineno})"
    listed = f" {found[0]}" if len(found) == 1 else "".join(f"\n  - {fault}" for fault in found)
    raise PlantDefinitionError(f"the plant {plant.name!r} cannot be used{where}:{listed}")


@lru_cache(maxsize=16)
def _faults_of_model(plant: Known | Plant) -> tuple[str, ...]:
    """Remembered: a plant never changes, it is looked at wherever it is looked up, and derivatives take a while."""
    numbers = list(_numbers(plant))
    if isinstance(plant, Known):
        return tuple(numbers or [*_bounds(plant), *_poles(plant)])
    found = [*(numbers or [*_bounds(plant), *_domains(plant), *_poles(plant)]), *_equations(plant)]
    return tuple(found or list(_rest(plant)) or _parameters(plant))


def _names(plant: Description) -> tuple[str, ...]:
    found = [] if isinstance(plant.name, str) and plant.name else [f"name is {plant.name!r}: give it a name"]
    for field in ("states", "inputs"):
        names: Any = getattr(plant, field)
        if isinstance(names, str):
            found.append(
                f"{field} is the text {names!r}: write ({names!r},), with the comma, for a single name"
            )
        elif not isinstance(names, tuple) or not all(isinstance(name, str) and name for name in names):
            found.append(f"{field} is {names!r}: give a tuple of names")
        elif not names:
            found.append(f"{field} is empty: the plant needs at least one")
    if found:
        return tuple(found)
    for name, count in Counter((*plant.states, *plant.inputs)).items():
        if count > 1:
            found.append(f"{count} states or inputs are called {name!r}: give each its own name")
        if name == TIME:
            found.append(f"a state or input is called {name!r}, the name of time: call it something else")
    return tuple(found)


def _numbers(plant: Description) -> Iterator[str]:
    """Shapes, and what must be finite."""
    for fields, names in ((STATE_VECTORS, plant.states), (INPUT_VECTORS, plant.inputs)):
        for field in fields:
            yield from _vector(field, getattr(plant, field), names)
    gain, shape = plant.safe_gain, (plant.m, plant.d)
    if gain is not None and not (_numeric(gain) and gain.shape == shape and np.isfinite(gain).all()):
        yield f"safe_gain is {_shown(gain)}: it needs finite numbers, a row for each input and a column for each state"


def _vector(field: str, value: Any, names: Sequence[str]) -> Iterator[str]:
    if not _numeric(value):
        yield f"{field} is {value!r}: give numbers, one for each of {', '.join(names)}"
    elif value.shape != (len(names),):
        yield f"{field} is {_shown(value)}: it needs {len(names)} entries, one for each of {', '.join(names)}"
    else:
        # A bound may be infinite.
        unusable = np.isnan(value) if field.endswith(("_min", "_max")) else ~np.isfinite(value)
        for i in np.flatnonzero(unusable).tolist():
            yield f"{field} of {names[i]} is {value[i]:g}: give a finite number"


def _bounds(plant: Description) -> Iterator[str]:
    known = (*plant.states, *plant.inputs)
    scale: Any = plant.scale
    if not isinstance(scale, Mapping):
        yield f"scale is {scale!r}: give it by name, as in {{{known[0]!r}: 1.0}}"
        return
    for name, width in scale.items():
        if name not in known:
            yield f"scale has {name!r}, which is no state or input: choose from {', '.join(known)}"
        elif not (isinstance(width, int | float) and 0.0 < width < np.inf):
            yield f"scale of {name} is {width!r}: give the half-width that counts as 1, a positive number"
    for axis, names, rest in (("x", plant.states, plant.x_e), ("u", plant.inputs, plant.u_e)):
        low, high = (getattr(plant, f"{axis}_{end}").tolist() for end in ("min", "max"))
        for i, name in enumerate(names):
            between = f"{axis}_min of {name} is {low[i]:g} and {axis}_max is {high[i]:g}"
            if not low[i] < high[i]:
                yield f"{between}: the lower bound must be below the upper one"
            elif not low[i] <= rest[i] <= high[i]:
                yield f"{axis}_e of {name} is {rest[i]:g}, but {between}: the equilibrium must lie between its bounds"
            elif name not in scale and not np.isfinite(high[i] - low[i]):
                yield (
                    f"{between}: give both bounds, or scale={{{name!r}: ...}}, the half-width that counts as 1 where "
                    "there is no bound"
                )
    for i in np.flatnonzero(plant.W < 0.0).tolist():
        yield f"W of {plant.states[i]} is {plant.W[i]:g}: a half-width is at least 0"
    ordered = plant.u_min < plant.u_max
    outside = (plant.safe_input < plant.u_min) | (plant.safe_input > plant.u_max)
    for i in np.flatnonzero(ordered & outside).tolist():
        yield (
            f"safe_input of {plant.inputs[i]} is {plant.safe_input[i]:g}, outside u_min = {plant.u_min[i]:g} and "
            f"u_max = {plant.u_max[i]:g}: the plant cannot apply it"
        )


def _domains(plant: Plant) -> Iterator[str]:
    for domain in plant.positive:
        if not isinstance(domain, Domain):
            yield f"positive has {domain!r}: give Domain(state, name, unit)"
            continue
        if not _is_index(domain.state, plant.d):
            yield f"positive: {domain.name} names state {domain.state!r}: {_indices(plant)}"
            continue
        for field in ("x_e", "x0"):
            value = getattr(plant, field)[domain.state]
            if not value > 0.0:
                yield f"{field} of {plant.states[domain.state]} is {value:g}: {domain.name} must be positive there"


def _poles(plant: Description) -> Iterator[str]:
    if plant.poles is None:
        return
    try:
        poles = np.asarray(plant.poles, dtype=complex)
    except (TypeError, ValueError):
        poles = np.zeros(0, dtype=complex)
    if poles.shape != (plant.d,) or not np.isfinite(poles).all():
        yield f"poles is {plant.poles!r}: it needs {plant.d} numbers, one for each state; None takes the LQR gain"
    elif (poles.real >= 0.0).any():
        yield f"poles is {plant.poles!r}: in continuous time a stable pole has a negative real part"
    elif Counter(poles.tolist()) != Counter(poles.conj().tolist()):
        yield f"poles is {plant.poles!r}: complex poles come in conjugate pairs"


def _choices(plant: Description) -> Iterator[str]:
    """What refers to states and inputs by index or by name."""
    known = (*plant.states, *plant.inputs)
    performance: Any = plant.performance
    if not isinstance(performance, tuple) or not performance:
        yield f"performance is {performance!r}: name at least one state by its index; {_indices(plant)}"
    else:
        for k, index in enumerate(performance):
            if not _is_index(index, plant.d):
                yield f"performance has {index!r}: {_indices(plant)}"
            elif index in performance[:k]:
                yield f"performance has {index!r} twice: each state once"
    kernel: Any = plant.kernel
    if not isinstance(kernel, tuple) or not kernel:
        yield f"kernel is {kernel!r}: give a tuple of at least one of {', '.join(known)}"
    else:
        for k, name in enumerate(kernel):
            if name not in known:
                yield f"kernel has {name!r}, which is no state or input: choose from {', '.join(known)}"
            elif name in kernel[:k]:
                yield f"kernel has {name!r} twice: each state or input once"
    units: Any = plant.units if isinstance(plant.units, Mapping) else {}
    without = [name for name in (*known, TIME) if not isinstance(units.get(name), str)]
    if without:
        yield f"units has none for {', '.join(without)}: give each one, '1' where it has no unit"


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
            "more digits if need be"
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


def _numeric(value: Any) -> bool:
    return isinstance(value, np.ndarray) and value.dtype == float


def _is_index(value: Any, length: int) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool) and 0 <= int(value) < length


def _indices(plant: Description) -> str:
    last = plant.d - 1
    return f"a state's index is from 0 ({plant.states[0]}) to {last} ({plant.states[last]})"


def _shown(value: Any) -> str:
    return str(value.tolist()) if isinstance(value, np.ndarray) else repr(value)
