"""The bytes of a message as a protobuf message with one field, which viewers of MCAP files can open.

    syntax = "proto3";
    package tandem_log;
    message Raw { bytes payload = 1; }

Viewers refuse a channel whose encoding they do not know, and msgpack is such an encoding. Protobuf puts a tag and a
length before the bytes and leaves the bytes as they are.
"""

from __future__ import annotations

SCHEMA_NAME = "tandem_log.Raw"
ENCODING = "protobuf"
"""The encoding of the channel and of its schema."""
_TAG = b"\x0a"
"""Tag of field 1, whose length follows."""
_CONTINUES = 0x80
_TYPE_BYTES, _LABEL_OPTIONAL = 12, 1
_LONGEST_VARINT = 5


class NotRaw(ValueError):
    """Bytes that are not a `tandem_log.Raw`."""


def wrap(payload: bytes) -> bytes:
    """Return the protobuf message that holds `payload`."""
    return _TAG + _varint(len(payload)) + payload


def unwrap(data: bytes) -> bytes:
    """Return the payload of `wrap`, bit for bit. Raises `NotRaw`: `wrap` did not make these bytes."""
    length = shift = 0
    for i, byte in enumerate(data[1 : 1 + _LONGEST_VARINT], 2):
        length |= (byte & (_CONTINUES - 1)) << shift
        shift += 7
        if byte < _CONTINUES:
            if data[:1] == _TAG and len(data) - i == length:
                return data[i:]
            break
    raise NotRaw(f"{len(data)} bytes that are not a message of {SCHEMA_NAME}")


def payload_of(encoding: str, data: bytes) -> bytes:
    """Return the payload of a message of a raw channel. Before format 3 it was not wrapped.

    Args:
        encoding: the channel's message encoding.
        data: the message.

    Raises:
        NotRaw: the channel's messages are wrapped, and this one is not.
    """
    return unwrap(data) if encoding == ENCODING else data


def schema() -> bytes:
    """Return the `FileDescriptorSet` of the message above, as protobuf."""
    # The numbers are those of google/protobuf/descriptor.proto.
    field = _text(1, "payload") + _number(3, 1) + _number(4, _LABEL_OPTIONAL) + _number(5, _TYPE_BYTES)
    message = _text(1, SCHEMA_NAME.rpartition(".")[2]) + _bytes(2, field + _text(10, "payload"))
    file = (
        _text(1, "tandem_log/raw.proto")
        + _text(2, SCHEMA_NAME.rpartition(".")[0])
        + _bytes(4, message)
        + _text(12, "proto3")
    )
    return _bytes(1, file)


def _varint(number: int) -> bytes:
    if number < _CONTINUES:
        return bytes((number,))
    found = bytearray()
    while number >= _CONTINUES:
        found.append(number & (_CONTINUES - 1) | _CONTINUES)
        number >>= 7
    found.append(number)
    return bytes(found)


def _bytes(field: int, data: bytes) -> bytes:
    return _varint(field << 3 | 2) + _varint(len(data)) + data


def _text(field: int, text: str) -> bytes:
    return _bytes(field, text.encode())


def _number(field: int, number: int) -> bytes:
    return _varint(field << 3) + _varint(number)
