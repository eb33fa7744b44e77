"""Messages to bytes and back. An invalid payload raises `BadMessage`, with a reason that can be counted."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from math import isfinite
from typing import Literal, TypeVar

import msgspec
import numpy as np
from msgspec import inspect

from protocol import messages as m
from protocol.topics import Topic

Reason = Literal["oversized", "malformed", "not finite", "wrong size"]
T = TypeVar("T", bound=msgspec.Struct)
UNREADABLE = (msgspec.DecodeError, UnicodeDecodeError, RecursionError, OverflowError)
"""All exceptions that msgspec raises for invalid bytes."""


class BadMessage(ValueError):
    """A payload that must not be obeyed. `reason` is for counting, the text is for a person."""

    def __init__(self, topic: str, reason: Reason, detail: str):
        super().__init__(f"{topic}: {reason}: {detail}")
        self.topic = topic
        self.reason: Reason = reason
        self.detail = detail


_encoder = msgspec.msgpack.Encoder()
_decoder = cache(msgspec.msgpack.Decoder)


def encode(message: m.Message) -> bytes:
    """Deterministic msgpack: the same message is the same bytes, in every process."""
    return _encoder.encode(message)


class Head(msgspec.Struct):
    """The first fields of every message."""

    run_id: m.RunId
    seq: m.Sequence


def head_of(payload: bytes) -> Head | None:
    """Return a message's writer and number without decoding the rest; None if they cannot be read."""
    try:
        return decode_as(Head, payload)
    except UNREADABLE:
        return None


def decode_as(kind: type[T], payload: bytes) -> T:
    """Decode with the schema alone. Raises `msgspec.DecodeError` (its `ValidationError` included)."""
    return _decoder(kind).decode(payload)


def decode(topic: Topic, payload: bytes) -> m.Message:
    """Decode a payload from the bus: size limit, schema, finiteness.

    Raises:
        BadMessage: with the reason; never anything else, whatever the bytes.
    """
    if len(payload) > topic.max_bytes:
        raise BadMessage(topic.name, "oversized", f"{len(payload)} bytes, at most {topic.max_bytes}")
    try:
        message = decode_as(topic.type, payload)
    except UNREADABLE as error:
        raise BadMessage(topic.name, "malformed", str(error)) from error
    field = None if _surely_finite(message) else first_non_finite(message)
    if field is not None:
        raise BadMessage(topic.name, "not finite", f"field {field}")
    return message


WITHOUT_FLOATS = (
    inspect.StrType,
    inspect.IntType,
    inspect.BoolType,
    inspect.NoneType,
    inspect.BytesType,
    inspect.LiteralType,
)


@cache
def _fields_with_floats(kind: type[msgspec.Struct]) -> tuple[str, ...]:
    """Return the fields of a Struct that may contain a float; most fields are texts and counts."""
    fields = msgspec.structs.fields(kind)
    return tuple(field.name for field in fields if _may_hold_float(inspect.type_info(field.type)))


def _may_hold_float(kind: inspect.Type) -> bool:
    match kind:
        case inspect.UnionType(types=types):
            return any(map(_may_hold_float, types))
        case (
            inspect.Metadata(type=inner)
            | inspect.ListType(item_type=inner)
            | inspect.DictType(value_type=inner)
        ):
            return _may_hold_float(inner)
        case inspect.StructType(cls=struct):
            return struct is m.Array or bool(_fields_with_floats(struct))
    return not isinstance(kind, WITHOUT_FLOATS)


def _surely_finite(value: object) -> bool:
    """Return False if `first_non_finite` must look closer; fast, because it runs on every message of a fast loop."""
    if isinstance(value, float):
        return isfinite(value)
    if value is None or value is msgspec.UNSET:
        return True
    if isinstance(value, list):
        first = value[0] if value else 0.0
        # Numbers that are all finite have a finite sum.
        if type(first) is float:
            return isfinite(sum(value))
        if type(first) is list and first and type(first[0]) is float:
            return isfinite(sum(map(sum, value)))
        return all(map(_surely_finite, value))
    if isinstance(value, dict):
        return all(map(_surely_finite, value.values()))
    if not isinstance(value, msgspec.Struct) or isinstance(value, m.Array):
        return False
    return all(_surely_finite(getattr(value, name)) for name in _fields_with_floats(type(value)))


def first_non_finite(value: object, path: str = "") -> str | None:
    """Return the name of the first field with a NaN or an infinity, or None. msgspec accepts both."""
    if isinstance(value, float):
        return None if isfinite(value) else path or "value"
    if value is None:
        return None
    if isinstance(value, m.Array):
        if value.dtype in ("<f4", "<f8") and not np.isfinite(np.frombuffer(value.data, value.dtype)).all():
            return path or "array"
        return None
    children: Iterable[tuple[object, object]]
    if isinstance(value, msgspec.Struct):
        children = [(name, getattr(value, name)) for name in _fields_with_floats(type(value))]
    elif isinstance(value, dict):
        children = value.items()
    elif isinstance(value, list):
        children = enumerate(value)
    else:
        return None
    for name, child in children:
        found = first_non_finite(child, f"{path}.{name}" if path else str(name))
        if found is not None:
            return found
    return None


def check_dimensions(topic: Topic, message: m.Message, d: int, m_inputs: int) -> None:
    """Raise `BadMessage` if a vector's length is not the plant's: d states, m_inputs inputs."""

    def wrong(detail: str) -> BadMessage:
        return BadMessage(topic.name, "wrong size", detail)

    def expect(name: str, values: list[float] | None, length: int) -> None:
        if values is not None and len(values) != length:
            raise wrong(f"{name} has {len(values)} entries, the plant has {length}")

    match message:
        case m.PlantState():
            expect("x", message.x, d)
            expect("applied", message.applied, m_inputs)
            for i, piece in enumerate(message.pieces):
                expect(f"pieces[{i}].u", piece.u, m_inputs)
        case m.Command():
            expect("u", message.u, m_inputs)
            if any(len(entry) != m_inputs for entry in message.plan):
                for i, entry in enumerate(message.plan):
                    expect(f"plan[{i}]", entry, m_inputs)
            if not message.plan:
                raise wrong("the plan is empty")
        case m.Backup():
            if len(message.gain) != m_inputs or not message.inputs:
                raise wrong("no entry in inputs, or in gain not one an input")
            for name, rows, length in (("gain", message.gain, d), ("inputs", message.inputs, m_inputs)):
                for i, row in enumerate(rows):
                    expect(f"{name}[{i}]", row, length)
        case m.Override():
            expect("u", message.u, m_inputs if message.mode == "manual" else 0)
        case m.Samples():
            for sample in message.samples:
                expect("x", sample.x, d)
                expect("u", sample.u, m_inputs)
                expect("h", sample.h, d)
                expect("variance", sample.variance or None, d)
                for i, pair in enumerate(sample.past):
                    expect(f"past[{i}]", pair, d + m_inputs)
        case m.OutputWeights():
            if len(message.K.shape) != 2 or message.K.shape[1] != d:
                raise wrong(f"K is {message.K.shape}, the plant has {d} states")
    if isinstance(message, m.Command | m.Backup) and not 0.0 < message.period < 3600.0:
        raise wrong(f"period {message.period} s")
