"""Lost messages and sending times, from the order and the times of the messages."""

from __future__ import annotations

import math
from collections import OrderedDict
from typing import Any

from node_runtime.bus.inbox import Follower
from protocol import topics

COUNTED = (topics.TICK.name, topics.RESULT.name)
"""Every tick has one of each, and both arrive in order, so a skipped number is a lost message."""
MOST_RUNS = 100
"""Number of runs that are remembered for each topic."""
DRIFT = 1e-4
"""Largest drift between two clocks, seconds per second: more than that of any quartz."""
LEAP_S = 1.0
"""Largest forward step of a sender's clock that is followed; after a larger one all later messages would seem old."""
OLDEST_S = 60.0
"""Largest age of a message; if it seems older, the sender's clock was set."""


class LostTicks:
    """Counts ticks whose messages were lost because of cut links or full queues."""

    def __init__(self, follow_silence: float):
        self._followed = {name: Follower(follow_silence) for name in COUNTED}
        self._last: dict[tuple[str, str], int] = {}
        """Number of the last message, by topic and run."""
        self.count: dict[str, int] = {}
        """Number of lost messages, by topic."""

    def take(self, name: str, run_id: str, seq: int, time_ns: int) -> int:
        """Return the number of lost messages just before this one.

        A message out of order, or of another run than the followed one, is a repetition or comes from a stranger.
        """
        if self._followed[name].accept(run_id, seq, time_ns * 1e-9) != "ok":
            return 0
        key = (name, run_id)
        last = self._last.get(key)
        if last is None and len(self._last) >= MOST_RUNS:
            del self._last[next(iter(self._last))]
        self._last[key] = seq
        missing = 0 if last is None else max(0, seq - last - 1)
        if missing:
            self.count[name] = self.count.get(name, 0) + missing
        return missing


class SendTimes:
    """When a message was sent, on the clock of the receiver.

    The sender's time is on the sender's own clock. The difference between the two clocks is taken to be the smallest
    difference between arrival and sending so far, so that the quickest message of a run counts as sent on arrival.
    """

    def __init__(self) -> None:
        self._clocks: OrderedDict[tuple[str, str], tuple[float, float]] = OrderedDict()
        """Smallest difference so far, and the time of its last update, by topic and run; seconds."""

    def of(self, name: str, head: Any, time_ns: int) -> int:
        """Return the sending time in ns, at most the arrival time `time_ns`; `time_ns` if the message has no time."""
        if name == topics.PLANT_STATE.name:
            sent = head.t
        elif name == topics.TICK.name:
            sent = head.t + head.lateness
        else:
            return time_ns
        arrived = time_ns * 1e-9
        key, difference = (name, head.run_id), arrived - sent
        if not math.isfinite(difference):
            return time_ns
        least, at = self._clocks.get(key, (difference, arrived))
        # Two clocks drift apart, and later messages may all be slower than the quickest one.
        least += DRIFT * max(0.0, arrived - at)
        if difference < least - LEAP_S:
            return time_ns
        late = difference - least
        if late < 0.0 or late > OLDEST_S:
            least, late = difference, 0.0
        self._clocks[key] = least, max(arrived, at)
        if len(self._clocks) > MOST_RUNS:
            self._clocks.popitem(last=False)
        return max(0, time_ns - round(late * 1e9))
