"""Large messages travel in pieces: a slow link is then never held for longer than one piece takes.

Zenoh closes a link on which one message has waited for too long, and at 1 Mbit/s a megabyte takes eight seconds. A
piece fits into one of its batches. Pieces travel at the key of their message, one after the other, and the receiver
puts them together before anybody reads them: whoever reads, logs or replays sees the whole message and nothing else.
"""

from __future__ import annotations

import threading
import zlib
from collections import OrderedDict
from collections.abc import Iterator

import msgspec

from node_runtime.rejected import BadMessages
from protocol.messages import Count

PIECE = 48 * 1024
"""Bytes of a message in each of its pieces but the last; what is no longer travels whole."""
MARK = b"\xc1"
"""Before each piece: the one byte that no msgpack begins with."""
HEADER = 512
"""Bytes, at most, around the data of a piece."""
TEXT = 128
PARTIAL = 1024
"""Messages that may be in pieces at once; a fleet's trainer hears one writer a plant."""


class Piece(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """One piece of a message of `size` bytes."""

    writer: str
    """run_id of the process that sends it."""
    number: Count
    """Which of its messages; every one in pieces has a higher number."""
    index: Count
    size: Count
    """Bytes of the whole message."""
    crc32: Count
    """Of the whole message."""
    data: bytes


class BadPieceError(ValueError):
    """A piece, or a message made of pieces, that must not be used; the text says why, for counting."""


_encoder, _decoder = msgspec.msgpack.Encoder(), msgspec.msgpack.Decoder(Piece)


def split(payload: bytes, writer: str, number: int) -> Iterator[bytes]:
    """What to send instead of a payload: itself, or its pieces in order."""
    if len(payload) <= PIECE:
        yield payload
        return
    crc32, view = zlib.crc32(payload), memoryview(payload)
    for index, begin in enumerate(range(0, len(payload), PIECE)):
        data = bytes(view[begin : begin + PIECE])
        yield MARK + _encoder.encode(Piece(writer, number, index, len(payload), crc32, data))


def is_piece(payload: bytes) -> bool:
    return payload[:1] == MARK


class _Partial:
    def __init__(self, piece: Piece):
        self.like = (piece.size, piece.crc32)
        self.number = piece.number
        self.parts: dict[int, bytes] = {}
        self.held = 0

    def add(self, piece: Piece) -> bool:
        """Whether the message is whole now."""
        if piece.index not in self.parts:
            self.parts[piece.index] = piece.data
            self.held += len(piece.data)
        return self.held == self.like[0]

    def whole(self) -> bytes:
        payload = b"".join(self.parts[index] for index in range(len(self.parts)))
        if zlib.crc32(payload) != self.like[1]:
            raise BadPieceError("pieces do not make the message")
        return payload


class Assembler:
    """Puts messages together, those of each writer one at a time. Any thread may call; nothing is raised.

    Args:
        limit: bytes held at most, of all messages that are not whole yet; the oldest gives way. As it does when there
            are more than `PARTIAL` of them.
        bad: where pieces that do not fit, and messages that never became whole, are counted.
    """

    def __init__(self, limit: int, bad: BadMessages):
        self.limit = limit
        self._bad = bad
        self._lock = threading.Lock()
        self._partial: OrderedDict[tuple[str, str], _Partial] = OrderedDict()
        self._held = 0

    @property
    def held(self) -> int:
        """Bytes that wait for the rest of their messages."""
        return self._held

    def whole(self, name: str, payload: bytes, largest: int) -> bytes | None:
        """What arrived at `name`: itself, or if it is a piece the message that it completes; None if it completes none.

        `largest`: bytes of a message there.
        """
        if not is_piece(payload):
            return payload
        try:
            with self._lock:
                return self._take(name, payload, largest)
        except BadPieceError as reason:
            self._bad.count(name, str(reason))
            return None

    def end(self) -> None:
        """Nothing more is coming: what is not whole now is lost."""
        with self._lock:
            while self._partial:
                self._forget(next(iter(self._partial)))

    def _take(self, name: str, payload: bytes, largest: int) -> bytes | None:
        piece = _read(payload, largest)
        at = (name, piece.writer)
        partial = self._partial.get(at)
        if partial is not None and piece.number != partial.number:
            if piece.number < partial.number:
                raise BadPieceError("late piece")
            # A writer sends one after the other, so the rest of the one before is not coming.
            self._forget(at)
            partial = None
        if partial is None:
            partial = self._partial[at] = _Partial(piece)
        elif partial.like != (piece.size, piece.crc32):
            raise BadPieceError("pieces of two messages")
        before = partial.held
        whole = partial.add(piece)
        self._held += partial.held - before
        if whole:
            del self._partial[at]
            self._held -= partial.held
            return partial.whole()
        while self._held > self.limit or len(self._partial) > PARTIAL:
            self._forget(next(iter(self._partial)))
        return None

    def _forget(self, at: tuple[str, str]) -> None:
        self._held -= self._partial.pop(at).held
        self._bad.count(at[0], "pieces lost", f"a message of {at[1]}")


def _read(payload: bytes, largest: int) -> Piece:
    if len(payload) > PIECE + HEADER:
        raise BadPieceError("oversized piece")
    try:
        piece = _decoder.decode(memoryview(payload)[len(MARK) :])
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError, OverflowError) as error:
        raise BadPieceError("malformed piece") from error
    if piece.size > largest:
        raise BadPieceError("oversized")
    if piece.size <= PIECE or len(piece.writer) > TEXT:
        raise BadPieceError("malformed piece")
    begin = piece.index * PIECE
    if begin >= piece.size or len(piece.data) != min(PIECE, piece.size - begin):
        raise BadPieceError("malformed piece")
    return piece
