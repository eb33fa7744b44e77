"""The attachment plant.json: the controller's numbers of its plant, and the hashes of the named files."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgspec

from lbmpc.plants import Known, Plant, PlantDefinitionError

LARGEST = 1_000_000
"""Largest size in bytes; sufficient for two hundred states."""


class PlantRecordError(ValueError):
    """An attachment that does not describe a plant; the text gives the reason."""


class _Content(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    known: dict[str, Any]
    files: dict[str, str]


def encode(plant: Known | Plant, files: Mapping[str, str]) -> str:
    """Encode a plant and the files of its configuration.

    plant: the known numbers; files: the sha256 of the files that the configuration names, by key.
    """
    known = plant if isinstance(plant, Known) else plant.known()
    content = _Content(known.to_builtins(), dict(files))
    return msgspec.json.format(msgspec.json.encode(content)).decode()


def decode(data: bytes) -> tuple[Known, dict[str, str]]:
    """Decode the arguments of `encode`, bit for bit. Raises `PlantRecordError` if the bytes cannot be used."""
    if len(data) > LARGEST:
        raise PlantRecordError(f"{len(data)} bytes, and {LARGEST} is the most")
    try:
        content = msgspec.json.decode(data, type=_Content)
        return Known.from_builtins(content.known), content.files
    except (msgspec.DecodeError, RecursionError, PlantDefinitionError) as error:
        raise PlantRecordError(str(error)) from error
