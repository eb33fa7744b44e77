"""The known part of a plant as it is written in JSON: plain numbers and words, which come back bit for bit."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Literal

import msgspec
import numpy as np

from lbmpc.plants.description import PlantDefinitionError

Number = float | Literal["inf", "-inf"]
"""JSON has no infinity."""


class Written(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, omit_defaults=True):
    """Field by field as in `Known`; complex numbers are pairs of their real and imaginary parts."""

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
    """Left out where there is none, as in what was written before there was such a field; so are the next."""
    u_rate_max: list[Number] | None = None
    rows: dict[str, dict[str, float]] = {}


FIELDS = Written.__struct_fields__


def written(fields: dict[str, Any]) -> dict[str, Any]:
    """The fields of a `Known`, by name, in what JSON has; the same whether a number was written 1 or 1.0.

    Raises:
        PlantDefinitionError: a field has what JSON, or `read`, would not take.
    """
    given = {name: _plain(fields[name]) for name in FIELDS}
    if given["dead_time"] == 0.0:
        # Only the default itself is left out, not what equals it.
        del given["dead_time"]
    return msgspec.to_builtins(_typed(given))


def read(data: object) -> dict[str, Any]:
    """The fields of a `Known` from what JSON gave. Raises `PlantDefinitionError`: it is something else."""
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
