"""The attachment plant.json: what the controller knew of its plant, as numbers, and the hashes of the files named."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import msgspec
import numpy as np

from lbmpc.plants import Known, Plant
from lbmpc.plants.inspection import faults

LARGEST = 1_000_000
"""Bytes: some hundred states."""


class PlantRecordError(ValueError):
    """An attachment that describes no plant; the text says why."""


class _Content(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    known: dict[str, Any]
    files: dict[str, str]


def encode(plant: Known | Plant, files: Mapping[str, str]) -> str:
    """files: the sha256 of what the configuration names, by key."""
    known = plant if isinstance(plant, Known) else plant.known()
    tree = {}
    for one in fields(Known):
        v = getattr(known, one.name)
        if isinstance(v, np.ndarray):
            v = [None if not np.isfinite(x) else x for x in v.tolist()] if v.ndim == 1 else v.tolist()
        if one.name == "poles" and v is not None:
            v = [[complex(p).real, complex(p).imag] for p in v]
        tree[one.name] = v
    return msgspec.json.format(msgspec.json.encode({"known": tree, "files": files})).decode()


def decode(data: bytes) -> tuple[Known, dict[str, str]]:
    """The inverse of `encode`. Raises `PlantRecordError`."""
    if len(data) > LARGEST:
        raise PlantRecordError(f"more than {LARGEST} bytes; no such plant is known")
    try:
        content = msgspec.json.decode(data, type=_Content)
        tree = dict(content.known)
        for n, sign in (("x_min", -1), ("u_min", -1), ("x_max", 1), ("u_max", 1)):
            tree[n] = [sign * np.inf if x is None else x for x in tree[n]]
        if tree["poles"] is not None:
            tree["poles"] = [complex(*p) for p in tree["poles"]]
        known = Known(**tree)
    except (msgspec.DecodeError, TypeError, KeyError, ValueError) as error:
        raise PlantRecordError(str(error)) from error
    wrong = faults(known)
    if wrong:
        raise PlantRecordError(wrong[0])
    return known, content.files
