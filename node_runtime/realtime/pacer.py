"""Slots on an absolute grid of the monotonic clock. Missed slots are skipped and counted, never run in a burst."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from dataclasses import dataclass

from node_runtime.realtime import clock


@dataclass(frozen=True, slots=True)
class Slot:
    """One slot of a periodic loop."""

    index: int
    """Number of slots since the start of the loop, including skipped ones."""
    time: float
    """Due time, in seconds on the monotonic clock."""
    skipped: int
    """Number of slots missed immediately before this one."""


class Grid:
    """The arithmetic of slots. The class is pure and has no clock. Times are in seconds.

    Slot k is due at anchor + k * period. After a step that took too long, the newest due slot is run late if less than
    `grace` of a period has passed since it was due. Otherwise the loop waits for the next slot. Two steps are therefore
    never closer than (1 - grace) periods.
    """

    def __init__(self, period: float, first: float, grace: float = 0.5):
        """`first`: due time of slot 0."""
        if not period > 0.0:
            raise ValueError(f"the period must be positive, not {period}")
        self.period = period
        self._grace = grace
        self._anchor = first
        self._next = 0
        self.skipped = 0
        """Number of slots skipped so far."""

    def next(self, now: float) -> Slot:
        """Return the slot to run next, given that the previous one is finished at `now`."""
        index = self._next
        late = now - self.due(index)
        if late > self._grace * self.period:
            index += math.ceil(late / self.period - self._grace)
        skipped = index - self._next
        self.skipped += skipped
        self._next = index + 1
        return Slot(index, self.due(index), skipped)

    def again(self, slot: Slot, now: float) -> Slot:
        """Return the slot to run after a sleep until `now`: `slot` itself if it is not too late, or a newer one."""
        if now - slot.time <= self._grace * self.period:
            return slot
        self._next = slot.index - slot.skipped
        self.skipped -= slot.skipped
        return self.next(now)

    def due(self, index: int) -> float:
        """Return the due time of slot `index`."""
        return self._anchor + index * self.period

    def reanchor(self, time: float) -> None:
        """Make the next slot due at `time`, without counting any slot as skipped."""
        self._anchor = time - self._next * self.period

    def slew(self, event: float, phase: float, gain: float = 0.3, limit: float = 0.05) -> float:
        """Shift the grid slightly, so that slots approach a distance `phase` after periodic events, one at `event`.

        Returns the present error in [-period/2, period/2], positive if slots are too early. One call shifts the grid by
        `gain` times the error, limited to `limit` periods.
        """
        off = math.remainder(event + phase - self._anchor, self.period)
        bound = limit * self.period
        self._anchor += min(max(gain * off, -bound), bound)
        return off


class Pacer:
    """A `Grid` with a sleep."""

    def __init__(self, grid: Grid, stop: threading.Event, wait: Callable[[float], bool] | None = None):
        """wait: waits until a time on the monotonic clock, returns False if told to stop; None for `sleep_until`."""
        self.grid = grid
        self._stop = stop
        self._wait = wait or self.sleep_until

    def next(self) -> tuple[Slot, float] | None:
        """Sleep until the next slot; return it and its lateness in seconds, or None if told to stop."""
        slot = self.grid.next(clock.now())
        while True:
            if not self._wait(slot.time):
                return None
            now = clock.now()
            # A process that was frozen or had no core wakes long after its slot, and must not run that slot.
            newer = self.grid.again(slot, now)
            if newer is slot:
                return slot, max(0.0, now - slot.time)
            slot = newer

    def sleep_until(self, time: float) -> bool:
        """Sleep until `time`, seconds on the monotonic clock; return False if told to stop."""
        # Signals set the event from another thread. A long sleep must notice it, and a short one must be exact.
        remaining = time - clock.now()
        if remaining > 0.2 and self._stop.wait(remaining - 0.1):
            return False
        clock.sleep_until(time)
        return not self._stop.is_set()
