"""Compare the output of a replay with the recorded messages: number of differences, and the first differing field."""

from __future__ import annotations

import struct
from typing import Any

import msgspec
import numpy as np

from protocol import codec
from protocol import messages as m
from protocol.messages import Array
from run_log.run import Entry

Shown = float | int | str | bool | None


class Difference(msgspec.Struct, frozen=True, kw_only=True):
    """One field of one tick that differs from the recording."""

    run_id: str
    tick: int
    field: str
    """For example "command.u[0]" or "keyframe.arrays.oracle.K[3, 1]"."""
    recorded: Shown
    replayed: Shown


class Comparison:
    """Counts comparisons, and keeps the first difference."""

    def __init__(self) -> None:
        self.ticks = 0
        self.keyframes = 0
        self.first: Difference | None = None
        self.differing: set[tuple[str, int]] = set()
        """(run, tick); tick -1 is the memory before the first tick."""
        self.largest: float | None = 0.0
        """See `ReplayResult.largest_difference`."""

    def compare(self, entry: Entry[Any], replayed: m.Message | None, name: str) -> None:
        """Compare byte for byte; `name` is the prefix of differing fields. None: the replay gave no such message."""
        payload = b"" if replayed is None else codec.encode(replayed)
        if payload == entry.payload or _without_later_fields(payload, entry) == entry.payload:
            return
        recorded = entry.message
        self.differing.add((recorded.run_id, recorded.seq))
        if self.first is None:
            found = first_difference(recorded, replayed, name)
            field, left, right = found or first_byte(entry.payload, payload, name)
            self.first = Difference(
                run_id=recorded.run_id, tick=recorded.seq, field=field, recorded=left, replayed=right
            )

    def compare_keyframe(self, entry: Entry[m.Keyframe], replayed: m.Keyframe) -> None:
        """Compare a keyframe, and count it."""
        self.compare(entry, replayed, "keyframe")
        self.keyframes += 1

    def measure(self, recorded: m.Command, replayed: m.Command) -> None:
        """Return the largest difference of two plans."""
        a, b = recorded.plan, replayed.plan
        if self.largest is None or [len(row) for row in a] != [len(row) for row in b]:
            self.largest = None
            return
        self.largest = max(self.largest, float(np.max(np.abs(np.array(a) - np.array(b)), initial=0.0)))


def first_difference(recorded: Any, replayed: Any, path: str) -> tuple[str, Shown, Shown] | None:
    """Return (field, recorded, replayed) of the first differing field, or None; floats bit for bit."""
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


def _without_later_fields(payload: bytes, entry: Entry[Any]) -> bytes:
    """Return the replayed message without default fields that the recorded one lacks, because an older version may have
    recorded it."""
    if not payload:
        return payload
    written = msgspec.msgpack.decode(entry.payload)
    defaults = {
        field.name: field.default if field.default_factory is msgspec.NODEFAULT else field.default_factory()
        for field in msgspec.structs.fields(type(entry.message))
    }
    fields = msgspec.msgpack.decode(payload).items()
    kept = {name: value for name, value in fields if name in written or value != defaults.get(name)}
    return msgspec.msgpack.encode(kept)


def first_byte(recorded: bytes, replayed: bytes, path: str) -> tuple[str, Shown, Shown]:
    """Return the position of the first differing byte, for payloads whose fields are equal."""
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
    if isinstance(value, float):
        return value if np.isfinite(value) else str(value)
    return value if value is None or isinstance(value, bool | int | str) else type(value).__name__
