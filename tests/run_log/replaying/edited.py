"""The run that these tests replay, and edited copies of it."""

from __future__ import annotations

import copy
import struct
from collections.abc import Callable
from typing import Any

import msgspec

from protocol import codec
from protocol import messages as m
from protocol.topics import Topic
from run_log.run import Entry, Run

RUN = "controller-simulated"
STEPS, EVERY = 90, 25
"""Number of its ticks, and ticks between two keyframes."""


def edited(run: Run, topic: Topic, seq: int, change: Callable[[Any], m.Message | None]) -> Run:
    """Return a copy in which one message is replaced or missing (None)."""
    other = copy.copy(run)
    entries = []
    for entry in run.entries(topic):
        message = change(entry.message) if entry.message.seq == seq else entry.message
        if message is not None:
            entries.append(Entry(entry.log_time, codec.encode(message), message))
    other.streams = {**run.streams, topic.name: entries}
    return other


def with_x(tick: m.Tick, x: list[float]) -> m.Tick:
    assert tick.state is not None
    return msgspec.structs.replace(tick, state=msgspec.structs.replace(tick.state, x=x))


def flip(value: float, bit: int) -> float:
    (bits,) = struct.unpack("<Q", struct.pack("<d", value))
    return struct.unpack("<d", struct.pack("<Q", bits ^ (1 << bit)))[0]
