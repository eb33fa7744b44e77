"""The parts of a message that events and counts need, for messages without a view."""

from __future__ import annotations

from typing import Any

import msgspec

from protocol import topics
from protocol.codec import UNREADABLE, Head, decode_as


class StateHead(Head):
    """The head of a `PlantState`."""

    t: float
    source: str


class TickHead(Head):
    """The head of a `Tick`."""

    t: float
    lateness: float
    late: bool
    skipped: int
    state_verdict: str
    truth: dict[str, float] = msgspec.field(default_factory=dict)


class ResultHead(Head):
    """The head of a `TickResult`."""

    mode: str
    status: str
    weights_verdict: str
    hidden_version: int
    set_margin: float | None = None
    weights_rolled_back: str = ""
    target_status: str = "none"
    sensor_faults: dict[str, str] = msgspec.field(default_factory=dict)
    reference: dict[str, float] = msgspec.field(default_factory=dict)
    reference_verdict: str = "none"
    reference_from: str = ""


class KeyframeHead(Head):
    """The head of a `Keyframe`."""

    resumed: str = ""


HEADS: dict[str, type[Head]] = {
    topics.PLANT_STATE.name: StateHead,
    topics.TICK.name: TickHead,
    topics.RESULT.name: ResultHead,
    topics.KEYFRAME.name: KeyframeHead,
}
"""Heads by topic name; `Head` is sufficient for all others."""


def head_of(name: str, payload: bytes) -> Any:
    """Return the head of a message of topic `name`; None if it cannot be read."""
    try:
        return decode_as(HEADS.get(name, Head), payload)
    except UNREADABLE:
        return None
