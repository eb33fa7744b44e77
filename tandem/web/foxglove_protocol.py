"""The part of the Foxglove WebSocket protocol that a read-only server of JSON channels needs. Pure.

Text frames are JSON objects with an `op`. A binary frame is one message of one channel.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping

import msgspec

from run_log.views.channel import Channel

SUBPROTOCOLS = ("foxglove.sdk.v1", "foxglove.websocket.v1")
"""Both names of the protocol. The parts that are used here are equal in both."""
MESSAGE_DATA = 0x01
HEADER = struct.Struct("<BIQ")
"""Head of a binary frame: opcode, subscription, time of the message in ns."""
ERROR = 2
"""Level of a status that a viewer shows as an error."""


class Subscription(msgspec.Struct, frozen=True):
    """A channel that a client asks for, and the number of the subscription, which the client chooses."""

    id: int
    channelId: int


class Subscribe(msgspec.Struct, frozen=True, tag="subscribe", tag_field="op"):
    subscriptions: list[Subscription]


class Unsubscribe(msgspec.Struct, frozen=True, tag="unsubscribe", tag_field="op"):
    subscriptionIds: list[int]


class Unknown(msgspec.Struct, frozen=True):
    """Any other request: parameters, services, a channel of the client's own."""

    op: str


Request = Subscribe | Unsubscribe | Unknown
_requests = msgspec.json.Decoder(Subscribe | Unsubscribe)
_unknown = msgspec.json.Decoder(Unknown)


def request_of(text: str | bytes) -> Request:
    """Return the request of a client.

    Raises:
        ValueError: the text is no request of this protocol.
    """
    try:
        return _requests.decode(text)
    except msgspec.ValidationError as error:
        try:
            unknown = _unknown.decode(text)
        except msgspec.ValidationError:
            raise ValueError(str(error)) from error
        if unknown.op in ("subscribe", "unsubscribe"):
            raise ValueError(str(error)) from error
        return unknown
    except (msgspec.DecodeError, RecursionError, UnicodeDecodeError) as error:
        raise ValueError(str(error)) from error


def server_info(name: str, session: str, metadata: Mapping[str, str]) -> str:
    """Return the first text frame. No capability is named, so a client offers nothing but to look.

    Args:
        name: what a viewer shows as the source.
        session: the same for as long as this server runs; a client that reconnects keeps its data then.
        metadata: facts about the system, by name.
    """
    return _text(
        {
            "op": "serverInfo",
            "name": name,
            "capabilities": [],
            "supportedEncodings": [],
            "metadata": dict(metadata),
            "sessionId": session,
        }
    )


def advertise(channels: Iterable[tuple[int, Channel]]) -> str:
    """Return the text frame that makes channels known, each with its number."""
    return _text(
        {
            "op": "advertise",
            "channels": [
                {
                    "id": number,
                    "topic": channel.topic,
                    "encoding": "json",
                    "schemaName": channel.schema_name,
                    "schema": channel.schema_text.decode(),
                    "schemaEncoding": "jsonschema",
                }
                for number, channel in channels
            ],
        }
    )


def unadvertise(numbers: Iterable[int]) -> str:
    """Return the text frame that takes channels back."""
    return _text({"op": "unadvertise", "channelIds": list(numbers)})


def refusal(text: str) -> str:
    """Return the text frame that tells a client that a request is not granted."""
    return _text({"op": "status", "level": ERROR, "message": text})


def message_data(subscription: int, time_ns: int, payload: bytes) -> bytes:
    """Return the binary frame of one message."""
    return HEADER.pack(MESSAGE_DATA, subscription, time_ns) + payload


def _text(tree: object) -> str:
    return msgspec.json.encode(tree).decode()
