"""Large messages travel in fragments: a slow link is then never held for longer than one fragment takes.

Zenoh closes a link on which one message has waited for too long, and at 1 Mbit/s a megabyte takes eight seconds. A
fragment fits into one of its batches. Fragments travel at the key of their message, one after the other, and the
receiver puts them together before anybody reads them: whoever reads, logs or replays sees the whole message and nothing
else. In the counters, and so in every log, they are called pieces.
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
"""Of a message in each of its fragments but the last; what is no longer travels whole."""
MARK = b"\xc1"
"""Before each fragment: the one byte that no msgpack begins with."""
HEADER_BYTES = 512
"""At most, around the data of a fragment."""
WRITER_CHARACTERS = 128
INCOMPLETE = 1024
"""Messages that may be incomplete at once; a fleet's trainer hears one writer a plant."""


class Fragment(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """One fragment of a message of `size` bytes."""

    writer: str
    """run_id of the process that sends it."""
    number: Count
    """Which of its messages; every one in fragments has a higher number."""
    index: Count
    size: Count
    """Bytes of the whole message."""
    crc32: Count
    """Of the whole message."""
    data: bytes


class BadFragmentError(ValueError):
    """A fragment, or a message made of pieces, that must not be used; the text says why, for counting."""


_encoder, _decoder = msgspec.msgpack.Encoder(), msgspec.msgpack.Decoder(Fragment)


class Fragmenter:
    """Cuts what one process sends; any thread may call."""

    def __init__(self, run_id: str):
        self._run_id = run_id
        self._numbers = itertools.count()

    def split(self, payload: bytes) -> Iterator[bytes]:
        """What to send instead of a payload: itself, or its fragments in order."""
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
    """Puts messages together, those of each writer one at a time. Any thread may call; nothing is raised.

    Args:
        limit: bytes held at most, of all messages that are not whole yet; the oldest gives way. As it does when there
            are more than `INCOMPLETE` of them.
        bad: where fragments that do not fit, and messages that never became whole, are counted.
    """

    def __init__(self, limit: int, bad: RejectedMessages):
        self.limit = limit
        self._bad = bad
        self._lock = threading.Lock()
        self._incomplete: OrderedDict[tuple[str, str], _Incomplete] = OrderedDict()
        self.held = 0
        """Bytes that wait for the rest of their messages."""

    def whole(self, name: str, payload: bytes, largest: int) -> bytes | None:
        """The message that a payload is, or that it completes if it is a fragment; None if it completes none.

        name: where it arrived; largest: bytes of a message there.
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
        """Nothing more is coming: what is not whole now is lost."""
        with self._lock:
            while self._incomplete:
                self._forget(next(iter(self._incomplete)))

    def _take(self, name: str, payload: bytes, largest: int) -> bytes | None:
        fragment = _read(payload, largest)
        at = (name, fragment.writer)
        message = self._incomplete.get(at)
        if message is not None and fragment.number > message.first.number:
            # A writer sends one after the other, so the rest of the one before is not coming.
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
