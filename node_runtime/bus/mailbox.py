"""Bounded places where the bus's receiving threads leave messages. It never blocks: the oldest gives way."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

# A queue of the largest messages must not take the machine's memory.
MAX_BYTES = 256 * 1024 * 1024


@dataclass(frozen=True, slots=True)
class Delivery:
    """One message as it arrived."""

    key: str
    payload: bytes
    received_ns: int
    """Monotonic clock (`clock.now_ns`) when the bus's receiving thread got it."""


class Mailbox:
    """A queue of at most `capacity` messages and `max_bytes` bytes; the oldest is dropped and counted."""

    def __init__(self, name: str, capacity: int, max_bytes: int = MAX_BYTES):
        if capacity < 1:
            raise ValueError(f"a mailbox needs a capacity of at least 1, not {capacity}")
        self.name = name
        self._capacity = capacity
        self._max_bytes = max_bytes
        self._items: deque[Delivery] = deque()
        self._bytes = 0
        self._arrived = threading.Condition(threading.Lock())
        self._overflow = 0
        self._received = 0

    def put(self, delivery: Delivery) -> None:
        """Called by the receiving thread; never blocks for longer than a few microseconds."""
        with self._arrived:
            self._items.append(delivery)
            self._bytes += len(delivery.payload)
            self._received += 1
            while len(self._items) > 1 and self._full():
                self._bytes -= len(self._items.popleft().payload)
                self._overflow += 1
            self._arrived.notify()

    def get(self, timeout_s: float = 0.0) -> Delivery | None:
        """The oldest message, waiting up to `timeout_s` for one; None when there is none."""
        with self._arrived:
            if not self._items and timeout_s > 0.0:
                self._arrived.wait_for(lambda: self._items, timeout_s)
            return self._pop()

    def drain(self) -> list[Delivery]:
        """Everything that is here, oldest first."""
        with self._arrived:
            items = list(self._items)
            self._items.clear()
            self._bytes = 0
            return items

    def _full(self) -> bool:
        return len(self._items) > self._capacity or self._bytes > self._max_bytes

    def _pop(self) -> Delivery | None:
        if not self._items:
            return None
        delivery = self._items.popleft()
        self._bytes -= len(delivery.payload)
        return delivery

    @property
    def overflow(self) -> int:
        """Messages dropped because nobody fetched them in time."""
        return self._overflow

    @property
    def received(self) -> int:
        """Messages that ever arrived here."""
        return self._received

    def __len__(self) -> int:
        return len(self._items)


class Latest:
    """The newest message of a topic, and only that one: an older one that nobody took is superseded."""

    def __init__(self, name: str):
        self.name = name
        self._box = Mailbox(name, capacity=1)

    def put(self, delivery: Delivery) -> None:
        """Called by the receiving thread."""
        self._box.put(delivery)

    def take_delivery(self) -> Delivery | None:
        """The newest message not yet taken, with its arrival time; never blocks."""
        return self._box.get()

    def wait_delivery(self, timeout_s: float) -> Delivery | None:
        """Like `take_delivery`, waiting up to `timeout_s` for one to arrive."""
        return self._box.get(timeout_s)

    def take(self) -> bytes | None:
        """The newest payload not yet taken; never blocks."""
        delivery = self._box.get()
        return None if delivery is None else delivery.payload

    def wait(self, timeout_s: float) -> bytes | None:
        """The newest payload not yet taken, waiting up to `timeout_s` for one to arrive."""
        delivery = self._box.get(timeout_s)
        return None if delivery is None else delivery.payload

    @property
    def superseded(self) -> int:
        """Messages that a newer one replaced before anybody took them; normal for a slow reader."""
        return self._box.overflow

    @property
    def received(self) -> int:
        return self._box.received


Sink = Callable[[Delivery], None]
