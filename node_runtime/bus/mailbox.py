"""Bounded mailboxes between the bus's receiving threads and the readers. They never block; the oldest is dropped."""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass

# Limit for queues of the largest messages, to protect the machine's memory.
MAX_BYTES = 256 * 1024 * 1024


@dataclass(frozen=True, slots=True)
class Delivery:
    """One message as it arrived."""

    key: str
    payload: bytes
    received_ns: int
    """Monotonic clock (`clock.now_ns`) when the bus's receiving thread received it."""


class Mailbox:
    """A queue of at most `capacity` messages and `max_bytes` bytes. Beyond that the oldest is dropped and counted."""

    def __init__(
        self,
        name: str,
        capacity: int,
        max_bytes: int = MAX_BYTES,
        arrived: threading.Condition | None = None,
    ):
        """arrived: notified of every message, so that a thread can wait for several mailboxes; None for its own."""
        if capacity < 1:
            raise ValueError(f"a mailbox needs a capacity of at least 1, not {capacity}")
        self.name = name
        self._capacity = capacity
        self._max_bytes = max_bytes
        self._items: deque[Delivery] = deque()
        self._bytes = 0
        self._arrived = arrived or threading.Condition(threading.Lock())
        self.overflow = 0
        """Number of messages dropped before they were read."""

    def put(self, delivery: Delivery) -> None:
        """Add a message, from the receiving thread; blocks for a few microseconds at most."""
        with self._arrived:
            self._items.append(delivery)
            self._bytes += len(delivery.payload)
            while len(self._items) > 1 and (
                len(self._items) > self._capacity or self._bytes > self._max_bytes
            ):
                self._bytes -= len(self._items.popleft().payload)
                self.overflow += 1
            self._arrived.notify()

    def get(self, timeout_s: float = 0.0) -> Delivery | None:
        """Return the oldest message, waiting up to `timeout_s` for one; None if there is none."""
        with self._arrived:
            if not self._items and timeout_s > 0.0:
                self._arrived.wait_for(lambda: self._items, timeout_s)
            if not self._items:
                return None
            delivery = self._items.popleft()
            self._bytes -= len(delivery.payload)
            return delivery

    def drain(self) -> list[Delivery]:
        """Return all messages, oldest first."""
        with self._arrived:
            items = list(self._items)
            self._items.clear()
            self._bytes = 0
            return items

    def __len__(self) -> int:
        return len(self._items)
