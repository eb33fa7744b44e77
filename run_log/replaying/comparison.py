"""Counts what was compared, and keeps the first difference."""

from __future__ import annotations

from typing import Any

import numpy as np

from protocol import codec
from protocol import messages as m
from run_log.replaying.difference import Difference, first_byte, first_difference
from run_log.run import Entry


class Comparison:
    """Of all that a replay makes with all that was recorded."""

    def __init__(self) -> None:
        self.ticks = 0
        self.keyframes = 0
        self.first: Difference | None = None
        self.differing: set[tuple[str, int]] = set()
        """(run, tick)."""
        self.largest: float | None = 0.0
        """See `ReplayResult.largest_difference`."""

    def compare(self, entry: Entry[Any], replayed: m.Message | None, name: str) -> None:
        """Byte for byte; `name` begins the field that a difference is in. None: the replay made no such message."""
        payload = b"" if replayed is None else codec.encode(replayed)
        if payload == entry.payload:
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
        """As `compare`, and counted."""
        self.compare(entry, replayed, "keyframe")
        self.keyframes += 1

    def measure(self, recorded: m.Command, replayed: m.Command) -> None:
        """How far two plans are apart."""
        a, b = recorded.plan, replayed.plan
        if self.largest is None or [len(row) for row in a] != [len(row) for row in b]:
            self.largest = None
            return
        self.largest = max(self.largest, float(np.max(np.abs(np.array(a) - np.array(b)), initial=0.0)))
