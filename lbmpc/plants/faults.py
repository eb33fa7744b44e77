"""Checks of a plant's description with messages for a person: names, numbers, bounds, poles and choices."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from lbmpc.plants.description import INPUT_VECTORS, STATE_VECTORS, Description, PlantDefinitionError
from lbmpc.plants.rows import PRIORITY, WORDS, coefficients

TIME = "t"
"""Name of time in a plant's units."""
SAME = 1e-5
"""Half-widths. A rest this close to the requested one counts as equal."""
LEVELS = 10
"""Number of priorities of rows. Each can cost a QP."""
INSIDE = 1e-6
"""Share of a row's range. u_e lies inside rows of inputs by this much, because inputs are pulled to it."""
W_IS = (
    "W is missing: give the half-widths of the model error, per second, one for each of {names}. "
    "`tandem identify` finds them from a log; zeros claim that the model is exact"
)


def refuse(name: str, found: Sequence[str], where: str = "") -> None:
    """Raise `unusable` if there are any faults."""
    if found:
        raise unusable(name, *found, where=where)


def unusable(name: str, *found: str, where: str = "") -> PlantDefinitionError:
    """Return the error for a plant with these faults, at least one; `where` says where it is written."""
    listed = f" {found[0]}" if len(found) == 1 else "".join(f"\n  - {fault}" for fault in found)
    return PlantDefinitionError(f"the plant {name!r} cannot be used{where}:{listed}")


def require_held(asked: Description, rest: Description, input_too: bool) -> None:
    """Raise `unusable` unless the nearest rest is the requested one: in x_e, and in u_e if that was given."""
    off = np.abs(rest.x_e - asked.x_e) / asked.x_scale
    if input_too:
        off = np.concatenate([off, np.abs(rest.u_e - asked.u_e) / asked.u_scale])
    if off.max() > SAME:
        where = point(asked) if input_too else point(asked).split(", u_e")[0]
        held = "it is not an equilibrium" if input_too else "no input holds it there"
        raise unusable(asked.name, f"{held}: {where}. The nearest rest is {point(rest)}")


def point(plant: Description) -> str:
    """Return x_e and u_e as text with twelve digits."""
    x_e, u_e = ([float(f"{value:.12g}") for value in axis.tolist()] for axis in (plant.x_e, plant.u_e))
    return f"x_e = {x_e}, u_e = {u_e}"


def name_faults(plant: Description) -> tuple[str, ...]:
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


def number_faults(plant: Description) -> Iterator[str]:
    """Check shapes and finite numbers."""
    for fields, names in ((STATE_VECTORS, plant.states), (INPUT_VECTORS, plant.inputs)):
        for field in fields:
            yield from _vector(field, getattr(plant, field), names)
    gain, shape = plant.safe_gain, (plant.m, plant.d)
    if gain is not None and not (numeric(gain) and gain.shape == shape and np.isfinite(gain).all()):
        yield f"safe_gain is {shown(gain)}: it needs finite numbers, a row for each input and a column for each state"
    if not (isinstance(plant.dead_time, int | float) and 0.0 <= plant.dead_time < np.inf):
        yield f"dead_time is {plant.dead_time!r}: give seconds, or 0 for a plant that responds at once"
    rates = plant.u_rate_max
    if rates is not None and not (numeric(rates) and rates.shape == (plant.m,) and (rates > 0.0).all()):
        yield (
            f"u_rate_max is {shown(rates)}: give the largest rate of each of {', '.join(plant.inputs)}, per second, "
            "as a positive number or inf"
        )
    yield from _rows(plant)


def _rows(plant: Description) -> Iterator[str]:
    """Check each row by itself."""
    rows: Any = plant.rows
    known = (*plant.states, *plant.inputs)
    if not isinstance(rows, Mapping):
        yield f"rows is {rows!r}: give rows by name, as in {{'sum': {{{known[0]!r}: 1.0, 'max': 1.0}}}}"
        return
    if rows and (words := [name for name in known if name in WORDS]):
        yield f"a state or input is called {words[0]!r}, which is a keyword of rows: use another name"
        return
    for key, row in rows.items():
        if not (isinstance(key, str) and key) or key in known:
            yield f"a row is called {key!r}: give it a name that differs from all states and inputs"
        elif not isinstance(row, Mapping) or not all(
            isinstance(value, int | float) and np.isfinite(value) for value in row.values()
        ):
            yield f"row {key} is {row!r}: give finite numbers by name, and leave out a bound that does not exist"
        else:
            yield from (f"row {key} {fault}" for fault in _one_row(plant, dict(row)))


def _one_row(plant: Description, row: dict[str, float]) -> Iterator[str]:
    parts, priority = coefficients(row), row.get(PRIORITY, 0)
    known = (*plant.states, *plant.inputs)
    if unknown := [name for name in parts if name not in known]:
        yield f"has {unknown[0]!r}, which is no state or input: choose from {', '.join(known)}"
        return
    if not any(parts.values()):
        yield f"has no coefficient but 0: give one for a state or an input, of {', '.join(known)}"
    of_inputs = [name for name in parts if name in plant.inputs]
    if of_inputs and len(of_inputs) < len(parts):
        yield "has states and inputs: give one row for states, and one for inputs"
    if of_inputs and PRIORITY in row:
        yield "is of inputs and has a priority: remove it, because inputs never leave U"
    if "min" not in row and "max" not in row:
        yield "has no bound: give min, max or both"
    elif not row.get("min", -np.inf) < row.get("max", np.inf):
        yield f"has min {row['min']:g} and max {row['max']:g}: min must be below max, or nothing keeps it"
    if priority not in range(LEVELS):
        yield f"has the priority {priority:g}: give a whole number from 0, that of the bounds, to {LEVELS - 1}"


def _vector(field: str, value: Any, names: Sequence[str]) -> Iterator[str]:
    if value is None:
        yield (W_IS if field == "W" else field + " is missing: give numbers, one for each of {names}").format(
            names=", ".join(names)
        )
    elif not numeric(value):
        yield f"{field} is {value!r}: give numbers, one for each of {', '.join(names)}"
    elif value.shape != (len(names),):
        yield f"{field} is {shown(value)}: it needs {len(names)} entries, one for each of {', '.join(names)}"
    else:
        # Bounds may be infinite.
        unusable = np.isnan(value) if field.endswith(("_min", "_max")) else ~np.isfinite(value)
        for i in np.flatnonzero(unusable).tolist():
            yield f"{field} of {names[i]} is {value[i]:g}: give a finite number"


def bound_faults(plant: Description) -> Iterator[str]:
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
                    f"{between}: give both bounds, or scale={{{name!r}: ...}}, the half-width that counts as 1 without "
                    "bounds"
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
    yield from _row_bounds(plant)


def _row_bounds(plant: Description) -> Iterator[str]:
    """Check that the equilibrium satisfies all rows, so that no polytope is empty. All widths are known here."""
    try:
        states, inputs = plant.state_rows, plant.input_rows
    except KeyError:
        # A missing half-width was reported above.
        return
    for rows, y, name, room in (
        (states, plant.x_e, "x_e", 0.0),
        (inputs, plant.u_e, "u_e", INSIDE),
        (inputs, plant.safe_input, "safe_input", 0.0),
    ):
        for i in np.flatnonzero(rows.beyond(y) > -room).tolist():
            low, high, value = rows.lower[i], rows.upper[i], float(rows.F[i] @ y)
            must = "must lie between them" if not room else "must lie strictly between them"
            yield f"row {rows.names[i]} is {value:g} at {name}, with min {low:g} and max {high:g}: {name} {must}"


def pole_faults(plant: Description) -> Iterator[str]:
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


def choice_faults(plant: Description) -> Iterator[str]:
    """Check the fields that refer to states and inputs by index or name."""
    known = (*plant.states, *plant.inputs)
    performance: Any = plant.performance
    if not isinstance(performance, tuple) or not performance:
        yield f"performance is {performance!r}: name at least one state by its index; {indices(plant)}"
    else:
        for k, index in enumerate(performance):
            if not is_index(index, plant.d):
                yield f"performance has {index!r}: {indices(plant)}"
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
    for field in ("units", "names"):
        texts: Any = getattr(plant, field)
        if not isinstance(texts, Mapping) or not all(
            isinstance(t, str) for pair in texts.items() for t in pair
        ):
            yield f"{field} is {texts!r}: give texts by name, as in {{{known[0]!r}: 'm'}}"
    units: Any = plant.units if isinstance(plant.units, Mapping) else {}
    without = [name for name in (*known, TIME) if not isinstance(units.get(name), str)]
    if without:
        yield f"units has none for {', '.join(without)}: give one for each, '1' for a number without unit"


def numeric(value: Any) -> bool:
    return isinstance(value, np.ndarray) and value.dtype == float


def is_index(value: Any, length: int) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool) and 0 <= int(value) < length


def indices(plant: Description) -> str:
    last = plant.d - 1
    return f"a state's index is from 0 ({plant.states[0]}) to {last} ({plant.states[last]})"


def shown(value: Any) -> str:
    return str(value.tolist()) if isinstance(value, np.ndarray) else repr(value)
