"""Large messages are sent in fragments, so that a slow link is occupied for at most the time of one fragment.

Zenoh closes a link on which a message has waited too long, and a megabyte takes eight seconds at 1 Mbit/s. A fragment
fits into one Zenoh batch. The fragments of a message use its key, one after the other, and the receiver joins them
before delivery. Readers, logs and replays therefore see whole messages only. Counters, and so logs, call fragments
"pieces".
"""

from __future__ import annotations

import itertools
import threading
import zlib
from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass, field

import msgspec

from node_runtime.rejected import RejectedMessages
from protocol.codec import UNREADABLE
from protocol.messages import Count

FRAGMENT_BYTES = 48 * 1024
"""Size of the data in each fragment except the last. Shorter messages are sent whole."""
MARK = b"\xc1"
"""First byte of a fragment: the only byte that cannot begin a msgpack message."""
HEADER_BYTES = 512
"""Maximum overhead of a fragment."""
WRITER_CHARACTERS = 128
INCOMPLETE = 1024
"""Largest number of incomplete messages. A fleet's trainer receives from one writer per plant."""


class Fragment(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """One fragment of a message of `size` bytes."""

    writer: str
    """run_id of the sending process."""
    number: Count
    """Number of the message. It increases with every message sent in fragments."""
    index: Count
    size: Count
    """Size of the whole message in bytes."""
    crc32: Count
    """CRC-32 of the whole message."""
    data: bytes


class BadFragmentError(ValueError):
    """A fragment, or a message made of fragments, that must not be used. The text is the reason for the counter."""


_encoder, _decoder = msgspec.msgpack.Encoder(), msgspec.msgpack.Decoder(Fragment)


class Fragmenter:
    """Splits the messages of one process; any thread may call."""

    def __init__(self, run_id: str):
        self._run_id = run_id
        self._numbers = itertools.count()

    def split(self, payload: bytes) -> Iterator[bytes]:
        """Yield what must be sent for a payload: the payload itself, or its fragments in order."""
        number = next(self._numbers)
        if len(payload) <= FRAGMENT_BYTES:
            yield payload
            return
        crc32, view = zlib.crc32(payload), memoryview(payload)
        for index, begin in enumerate(range(0, len(payload), FRAGMENT_BYTES)):
            data = bytes(view[begin : begin + FRAGMENT_BYTES])
            yield MARK + _encoder.encode(Fragment(self._run_id, number, index, len(payload), crc32, data))


@dataclass
class _Incomplete:
    first: Fragment
    parts: dict[int, bytes] = field(default_factory=dict)
    held: int = 0


class Reassembler:
    """Joins the fragments of messages, one message per writer at a time. Any thread may call; nothing is raised.

    Args:
        limit: bytes held for all incomplete messages. Beyond it, or beyond `INCOMPLETE` messages, the oldest is
        dropped. bad: counts invalid fragments and messages that stayed incomplete.
    """

    def __init__(self, limit: int, bad: RejectedMessages):
        self.limit = limit
        self._bad = bad
        self._lock = threading.Lock()
        self._incomplete: OrderedDict[tuple[str, str], _Incomplete] = OrderedDict()
        self.held = 0
        """Bytes of incomplete messages."""

    def whole(self, name: str, payload: bytes, largest: int) -> bytes | None:
        """Return the message of a payload, or the message that a fragment completes; None if it completes none.

        name: topic of the payload; largest: maximum size of a message there, in bytes.
        """
        if payload[:1] != MARK:
            return payload
        try:
            with self._lock:
                return self._take(name, payload, largest)
        except BadFragmentError as reason:
            self._bad.count(name, str(reason))
            return None

    def end(self) -> None:
        """Drop all incomplete messages, because no more fragments will arrive."""
        with self._lock:
            while self._incomplete:
                self._forget(next(iter(self._incomplete)))

    def _take(self, name: str, payload: bytes, largest: int) -> bytes | None:
        fragment = _read(payload, largest)
        at = (name, fragment.writer)
        message = self._incomplete.get(at)
        if message is not None and fragment.number > message.first.number:
            # A writer sends one message after the other, so the previous one will not be completed.
            self._forget(at)
            message = None
        if message is None:
            message = self._incomplete[at] = _Incomplete(fragment)
        first = message.first
        if fragment.number < first.number:
            raise BadFragmentError("late piece")
        if (fragment.size, fragment.crc32) != (first.size, first.crc32):
            raise BadFragmentError("pieces of two messages")
        if fragment.index not in message.parts:
            message.parts[fragment.index] = fragment.data
            message.held += len(fragment.data)
            self.held += len(fragment.data)
        if message.held == first.size:
            self.held -= message.held
            del self._incomplete[at]
            payload = b"".join(message.parts[index] for index in range(len(message.parts)))
            if zlib.crc32(payload) != first.crc32:
                raise BadFragmentError("pieces do not make the message")
            return payload
        while self.held > self.limit or len(self._incomplete) > INCOMPLETE:
            self._forget(next(iter(self._incomplete)))
        return None

    def _forget(self, at: tuple[str, str]) -> None:
        self.held -= self._incomplete.pop(at).held
        self._bad.count(at[0], "pieces lost", f"a message of {at[1]}")


def _read(payload: bytes, largest: int) -> Fragment:
    if len(payload) > FRAGMENT_BYTES + HEADER_BYTES:
        raise BadFragmentError("oversized piece")
    try:
        fragment = _decoder.decode(memoryview(payload)[len(MARK) :])
    except UNREADABLE as error:
        raise BadFragmentError("malformed piece") from error
    if fragment.size > largest:
        raise BadFragmentError("oversized")
    if fragment.size <= FRAGMENT_BYTES or len(fragment.writer) > WRITER_CHARACTERS:
        raise BadFragmentError("malformed piece")
    begin = fragment.index * FRAGMENT_BYTES
    if begin >= fragment.size or len(fragment.data) != min(FRAGMENT_BYTES, fragment.size - begin):
        raise BadFragmentError("malformed piece")
    return fragment
