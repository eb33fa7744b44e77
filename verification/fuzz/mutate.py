"""Make valid bytes bad, quickly: a few microseconds each, and the same ones for the same seed."""

from __future__ import annotations

import copy
import random
import struct
from collections.abc import Callable, Sequence
from typing import Any

import msgspec

MARKERS = (
    b"\xc1",  # the one byte that msgpack never uses
    b"\xdd\xff\xff\xff\xff",  # an array of 2^32 - 1 entries
    b"\xdf\xff\xff\xff\xff",  # a map of as many
    b"\xc6\xff\xff\xff\xff",  # bytes, text
    b"\xdb\xff\xff\xff\xff",
    b"\xcf" + b"\xff" * 8,  # the largest integer, the smallest
    b"\xd3\x80" + b"\x00" * 7,
    b"\xc7\x08\x01" + b"\x00" * 8,  # an extension type
    b"\xd6\xff" + b"\xff" * 4,  # a time stamp
    b"\xa2\xff\xfe",  # a text with invalid UTF-8
    b"\x91" * 2000,  # lists in lists
    b"\x81\xa1a" * 1000,  # maps in maps
    b"\xc0",
    b"\x80",
    b"\x90",
)
NUMBERS = tuple(
    b"\xcb" + struct.pack(">d", value)
    for value in (float("nan"), float("inf"), -float("inf"), 1e308, -0.0, 5e-324)
)
TEXTS = (
    b"inf",
    b"nan",
    b"-1",
    b"[[",
    b"}}",
    b'"',
    b"\x00",
    b"1e999",
    b"99999999999999999999",
    b"\xff\xfe",
    b"# ",
    b"=",
)

VALUES: tuple[Any, ...] = (
    *(None, True, 0, -1, -2, 2**31, 2**63 - 1, 2**64 - 1, -(2**63)),
    *(float("nan"), float("inf"), 1e308, -1e308, 5e-324),
    *("", "x" * 65, "x" * 5000, "\x00", b"", b"\xff" * 9, [], {}, [[]], [{}], {"a": 1}, [0.0] * 1000),
)
ARRAYS: tuple[Any, ...] = tuple(
    {"dtype": dtype, "shape": shape, "data": data}
    for dtype in ("<f4", "<f8", "<i8", "|u1")
    for shape, data in (
        ([0, 2**62], b""),
        ([2**40, 0, 2**40], b""),
        ([1] * 70, b"\x00" * 8),
        ([], b"\x00" * 8),
        ([], b"\x00" * 4),
        ([2, 3], b"\xff" * 24),
        ([2, 3], b"\x7f" * 48),
        ([1], b"\x00" * 8),
        ([0], b""),
    )
)
"""Shapes that numpy cannot hold, and values that no computation accepts, in place of an array."""

Mutation = Callable[[bytes, Sequence[bytes], random.Random], bytes]


def flip(payload: bytes, others: Sequence[bytes], rng: random.Random) -> bytes:
    """Replace one to four bytes."""
    if not payload:
        return b"\x00"
    changed = bytearray(payload)
    for _ in range(1 + int(4 * rng.random())):
        changed[int(rng.random() * len(changed))] = int(256 * rng.random())
    return bytes(changed)


def cut(payload: bytes, others: Sequence[bytes], rng: random.Random) -> bytes:
    """The end is missing."""
    return payload[: int(rng.random() * len(payload))]


def drop(payload: bytes, others: Sequence[bytes], rng: random.Random) -> bytes:
    """A stretch is missing."""
    at = int(rng.random() * len(payload))
    return payload[:at] + payload[at + 1 + int(16 * rng.random()) :]


def double(payload: bytes, others: Sequence[bytes], rng: random.Random) -> bytes:
    """Repeat a stretch."""
    at = int(rng.random() * len(payload))
    return payload[: at + 1 + int(32 * rng.random())] + payload[at:]


def splice(payload: bytes, others: Sequence[bytes], rng: random.Random) -> bytes:
    """Join the beginning of one message and the end of another."""
    other = others[int(rng.random() * len(others))]
    return payload[: int(rng.random() * len(payload))] + other[int(rng.random() * len(other)) :]


def mark(payload: bytes, others: Sequence[bytes], rng: random.Random) -> bytes:
    """Insert bytes with a special meaning in the middle."""
    marker = MARKERS[int(rng.random() * len(MARKERS))]
    at = int(rng.random() * len(payload))
    return payload[:at] + marker + payload[at + len(marker) * (rng.random() < 0.5) :]


def number(payload: bytes, others: Sequence[bytes], rng: random.Random) -> bytes:
    """Replace one of its floating-point numbers by an extreme one."""
    strange = NUMBERS[int(rng.random() * len(NUMBERS))]
    at = payload.find(b"\xcb", int(rng.random() * len(payload)))
    return payload[:at] + strange + payload[at + 9 :] if at >= 0 else flip(payload, others, rng)


def noise(payload: bytes, others: Sequence[bytes], rng: random.Random) -> bytes:
    """Nothing of it is left."""
    return rng.randbytes(int(200 * rng.random()))


def whole(payload: bytes, others: Sequence[bytes], rng: random.Random) -> bytes:
    """Change nothing."""
    return payload


def text(payload: bytes, others: Sequence[bytes], rng: random.Random) -> bytes:
    """Insert a word with a special meaning for readers of texts."""
    word = TEXTS[int(rng.random() * len(TEXTS))]
    at = int(rng.random() * len(payload))
    return payload[:at] + word + payload[at + int(8 * rng.random()) :]


def rebuild(payload: bytes, others: Sequence[bytes], rng: random.Random) -> bytes:
    """Well-formed msgpack with one changed value: a schema must refuse it, or a reader handle it."""
    try:
        tree = msgspec.msgpack.decode(payload)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return payload
    places: list[tuple[Any, Any]] = []
    pending = [tree]
    while pending:
        node = pending.pop()
        inner = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
        for key, value in inner:
            places.append((node, key))
            if isinstance(value, (dict, list)) and len(places) < 300:
                pending.append(value)
    if not places:
        return payload
    node, key = places[int(rng.random() * len(places))]
    strange = ARRAYS if isinstance(node[key], dict) and "shape" in node[key] else VALUES
    node[key] = strange[int(rng.random() * len(strange))]
    try:
        return msgspec.msgpack.encode(tree)
    except (TypeError, OverflowError, RecursionError):
        return payload


BINARY: tuple[Mutation, ...] = (
    flip,
    flip,
    flip,
    cut,
    drop,
    double,
    splice,
    mark,
    mark,
    number,
    rebuild,
    rebuild,
    noise,
    whole,
)
TEXTUAL: tuple[Mutation, ...] = (flip, cut, drop, double, splice, text, text, noise, whole)


class Mutator:
    """Endless bad payloads, from seeds."""

    def __init__(
        self, seeds: Sequence[bytes], others: Sequence[bytes], mutations: Sequence[Mutation], seed: int
    ):
        """`others`: messages for splicing."""
        self._seeds, self._others, self._mutations = seeds, others, mutations
        self._rng = random.Random(seed)

    def __call__(self) -> bytes:
        rng = self._rng
        payload = self._seeds[int(rng.random() * len(self._seeds))]
        payload = self._mutations[int(rng.random() * len(self._mutations))](payload, self._others, rng)
        if rng.random() < 0.2:
            payload = self._mutations[int(rng.random() * len(self._mutations))](payload, self._others, rng)
        return payload


STRANGE: tuple[Any, ...] = (
    *(0, -1, 1, 0.5, -0.0, 1e-300, 5e-324, 1e-9, 1e9, 1e150, 1e308, -1e308, 2**62, 2**70),
    *(True, None, "", "x", "../x", "/dev/null", "\u001b[2J", [], [[]], [0.0], [[0.0]], {}, "x" * 5000),
)
"""Any JSON value in place of another."""
NUMBERS_IN_STRANGE = 14


class Reteller:
    """Endless well-formed JSON with a few changed values."""

    def __init__(self, text: bytes, seed: int):
        self._text, self._rng = text, random.Random(seed)

    def __call__(self) -> bytes:
        tree = msgspec.json.decode(self._text)
        for _ in range(self._rng.choice((0, 1, 1, 2, 5))):
            self._change(tree)
        return msgspec.json.encode(tree)

    def _change(self, node: Any) -> None:
        rng = self._rng
        while node:
            key = rng.choice(list(node) if isinstance(node, dict) else range(len(node)))
            inner = node[key]
            if not isinstance(inner, (dict, list)) or not inner or rng.random() < 0.1:
                break
            node = inner
        else:
            return
        change = rng.random()
        if isinstance(node, list) and change < 0.2:
            del node[key]
        elif isinstance(node, list) and change < 0.3:
            node.append(copy.deepcopy(inner))
        elif isinstance(inner, float) and change < 0.5:
            node[key] = inner * rng.choice((-1.0, 0.0, 0.9, 1.1, 1e6))
        else:
            like = isinstance(inner, (int, float)) and rng.random() < 0.8
            node[key] = copy.deepcopy(rng.choice(STRANGE[:NUMBERS_IN_STRANGE] if like else STRANGE))
