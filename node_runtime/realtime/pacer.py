"""Slots on an absolute grid of the monotonic clock. Missed ones are skipped and counted, never a burst."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from dataclasses import dataclass

from node_runtime.realtime import clock


@dataclass(frozen=True, slots=True)
class Slot:
    """One turn of a periodic loop."""

    index: int
    """Slots since the loop began, skipped ones included."""
    time: float
    """When it is due, seconds on the monotonic clock."""
    skipped: int
    """Slots missed immediately before this one."""


class Grid:
    """The arithmetic of slots; pure, no clock of its own. Times in seconds.

    Slot k is due at anchor + k * period. After a step that took too long, the newest slot due is run late
    when less than `grace` of a period has passed since, otherwise the loop waits for the next: two steps are
    never closer than (1 - grace) periods.
    """

    def __init__(self, period: float, first: float, grace: float = 0.5):
        """`first`: when slot 0 is due."""
        if not period > 0.0:
            raise ValueError(f"the period must be positive, not {period}")
        self.period = period
        self._grace = grace
        self._anchor = first
        self._next = 0
        self.skipped = 0
        """All slots skipped so far."""

    def next(self, now: float) -> Slot:
        """The slot to run next, at `now`, when the one before has been dealt with."""
        index = self._next
        late = now - self.due(index)
        if late > self._grace * self.period:
            index += math.ceil(late / self.period - self._grace)
        skipped = index - self._next
        self.skipped += skipped
        self._next = index + 1
        return Slot(index, self.due(index), skipped)

    def again(self, slot: Slot, now: float) -> Slot:
        """The slot to run instead of `slot`, which was slept through until `now`; itself where it still may be run."""
        if now - slot.time <= self._grace * self.period:
            return slot
        self._next = slot.index - slot.skipped
        self.skipped -= slot.skipped
        return self.next(now)

    def due(self, index: int) -> float:
        """When slot `index` is due."""
        return self._anchor + index * self.period

    def reanchor(self, time: float) -> None:
        """Let the next slot be due at `time`, whatever the grid was; no slot counts as skipped for it."""
        self._anchor = time - self._next * self.period

    def slew(self, event: float, phase: float, gain: float = 0.3, limit: float = 0.05) -> float:
        """Shift the grid a little, so that slots come to lie `phase` after periodic events, one at `event`.

        Returns how far off the grid was, in [-period/2, period/2]: positive when slots come too early. One
        call shifts by `gain` of that, at most `limit` periods.
        """
        off = math.remainder(event + phase - self._anchor, self.period)
        bound = limit * self.period
        self._anchor += min(max(gain * off, -bound), bound)
        return off


class Pacer:
    """A `Grid` with sleep."""

    def __init__(self, grid: Grid, stop: threading.Event, wait: Callable[[float], bool] | None = None):
        """wait: waits until a time on the monotonic clock, False when told to stop; None: `sleep_until`."""
        self.grid = grid
        self._stop = stop
        self._wait = wait or self.sleep_until

    def next(self) -> tuple[Slot, float] | None:
        """Sleep until the next slot; it and its lateness in seconds, or None when told to stop."""
        slot = self.grid.next(clock.now())
        while True:
            if not self._wait(slot.time):
                return None
            now = clock.now()
            # A process that was frozen, or without a core, wakes long after its slot: that one is over.
            newer = self.grid.again(slot, now)
            if newer is slot:
                return slot, max(0.0, now - slot.time)
            slot = newer

    def sleep_until(self, time: float) -> bool:
        """Sleep until `time`, seconds on the monotonic clock; False when told to stop."""
        # Signals set the event from a thread of their own: a long sleep must notice it, a short one is exact.
        remaining = time - clock.now()
        if remaining > 0.2 and self._stop.wait(remaining - 0.1):
            return False
        clock.sleep_until(time)
        return not self._stop.is_set()
