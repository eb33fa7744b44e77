"""The JSON form of the known part of a plant: plain numbers and text that are read back exactly."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Literal

import msgspec
import numpy as np

from lbmpc.plants.description import PlantDefinitionError

Number = float | Literal["inf", "-inf"]
"""A number, or text for infinity, which JSON does not have."""


class Written(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, omit_defaults=True):
    """The fields of `Known`; complex numbers are pairs of real and imaginary part."""

    name: str
    states: list[str]
    inputs: list[str]
    units: dict[str, str]
    names: dict[str, str]
    A: list[list[float]]
    B: list[list[float]]
    period: float | None
    x_e: list[float]
    u_e: list[float]
    x_min: list[Number]
    x_max: list[Number]
    u_min: list[Number]
    u_max: list[Number]
    scale: dict[str, float]
    W: list[float]
    x0: list[float]
    safe_input: list[float]
    safe_gain: list[list[float]] | None
    performance: list[int]
    kernel: list[str]
    poles: list[float | tuple[float, float]] | None
    dead_time: float = 0.0
    """Omitted if zero, as in data from before this field existed; so are the next fields."""
    u_rate_max: list[Number] | None = None
    rows: dict[str, dict[str, float]] = {}


FIELDS = Written.__struct_fields__


def written(fields: dict[str, Any]) -> dict[str, Any]:
    """Return the fields of a `Known` as JSON-compatible data; 1 and 1.0 give the same result.

    Raises:
        PlantDefinitionError: a field has a value that JSON or `read` does not accept.
    """
    given = {name: _plain(fields[name]) for name in FIELDS}
    if given["dead_time"] == 0.0:
        # Only a value equal to the default is omitted.
        del given["dead_time"]
    return msgspec.to_builtins(_typed(given))


def read(data: object) -> dict[str, Any]:
    """Return the fields of a `Known` from JSON data. Raises `PlantDefinitionError` for other data."""
    found = _typed(data)
    fields = msgspec.structs.asdict(found)
    for name in ("x_min", "x_max", "u_min", "u_max", "u_rate_max"):
        if fields[name] is not None:
            fields[name] = [float(value) for value in fields[name]]
    if found.poles is not None:
        fields["poles"] = [complex(*pole) if isinstance(pole, tuple) else pole for pole in found.poles]
    return fields


def _typed(data: object) -> Written:
    try:
        return msgspec.convert(data, Written)
    except msgspec.ValidationError as error:
        raise PlantDefinitionError(f"this is not the known part of a plant: {error}") from error


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, list | tuple):
        return [_plain(one) for one in value]
    if isinstance(value, complex):
        return [value.real, value.imag]
    if isinstance(value, float) and math.isinf(value):
        return "inf" if value > 0 else "-inf"
    if isinstance(value, Mapping):
        return {name: _plain(one) for name, one in value.items()}
    return value.item() if isinstance(value, np.generic) else value
