"""Where two messages differ: the first field, bit for bit, in words."""

from __future__ import annotations

import struct
from typing import Any

import msgspec
import numpy as np

from protocol.messages import Array

Shown = float | int | str | bool | None


class Difference(msgspec.Struct, frozen=True, kw_only=True):
    """One field of one tick that did not come out as it was recorded."""

    run_id: str
    tick: int
    field: str
    """For example "command.u[0]" or "keyframe.arrays.oracle.K[3, 1]"."""
    recorded: Shown
    replayed: Shown


def first_difference(recorded: Any, replayed: Any, path: str) -> tuple[str, Shown, Shown] | None:
    """(field, recorded, replayed) of the first field that differs, or None; floats bit for bit."""
    if isinstance(recorded, Array) and isinstance(replayed, Array):
        return _arrays(recorded, replayed, path)
    if type(recorded) is not type(replayed):
        return path, _shown(recorded), _shown(replayed)
    if isinstance(recorded, msgspec.Struct):
        pairs = [
            (f".{name}", getattr(recorded, name), getattr(replayed, name))
            for name in recorded.__struct_fields__
        ]
    elif isinstance(recorded, dict):
        if recorded.keys() != replayed.keys():
            return path, ", ".join(sorted(recorded)), ", ".join(sorted(replayed))
        pairs = [(f".{name}", recorded[name], replayed[name]) for name in recorded]
    elif isinstance(recorded, list):
        if len(recorded) != len(replayed):
            return path, f"{len(recorded)} entries", f"{len(replayed)} entries"
        pairs = [(f"[{i}]", a, b) for i, (a, b) in enumerate(zip(recorded, replayed, strict=True))]
    else:
        same = _bits(recorded) == _bits(replayed)
        return None if same else (path, _shown(recorded), _shown(replayed))
    for step, a, b in pairs:
        found = first_difference(a, b, path + step)
        if found is not None:
            return found
    return None


def first_byte(recorded: bytes, replayed: bytes, path: str) -> tuple[str, Shown, Shown]:
    """For payloads that differ although their fields do not: the place of the first byte that does."""
    shorter = min(len(recorded), len(replayed))
    at = next((i for i in range(shorter) if recorded[i] != replayed[i]), shorter)
    return f"{path} (byte {at})", recorded[at : at + 8].hex(" "), replayed[at : at + 8].hex(" ")


def _arrays(recorded: Array, replayed: Array, path: str) -> tuple[str, Shown, Shown] | None:
    if (recorded.dtype, recorded.shape) != (replayed.dtype, replayed.shape):
        return path, f"{recorded.dtype} {recorded.shape}", f"{replayed.dtype} {replayed.shape}"
    if recorded.data == replayed.data:
        return None
    width = np.dtype(recorded.dtype).itemsize
    a, b = (np.frombuffer(array.data, np.uint8).reshape(-1, width) for array in (recorded, replayed))
    flat = int(np.flatnonzero((a != b).any(axis=1))[0])
    index = ", ".join(str(i) for i in np.unravel_index(flat, recorded.shape)) if recorded.shape else ""
    left, right = (array.numpy().reshape(-1)[flat].item() for array in (recorded, replayed))
    return f"{path}[{index}]", _shown(left), _shown(right)


def _bits(value: Any) -> Any:
    return struct.pack("<d", value) if isinstance(value, float) else value


def _shown(value: Any) -> Shown:
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float) and np.isfinite(value):
        return value
    return str(value) if isinstance(value, float) else type(value).__name__
