"""From raw payloads to accepted messages: decoded, of valid size, in order, and of known age."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, Literal, TypeVar, cast

from node_runtime.bus.mailbox import Delivery, Mailbox
from node_runtime.bus.zenoh_bus import Bus
from node_runtime.realtime import clock
from protocol import codec
from protocol.messages import Message
from protocol.topics import Topic

log = logging.getLogger(__name__)

M = TypeVar("M", bound=Message)
FollowVerdict = Literal["ok", "out of order", "foreign"]


class Follower:
    """Selects the sender to follow on one topic. The class is pure and has no clock.

    The first process incarnation seen is followed, with rising sequence numbers. After `silence` seconds without an
    accepted message, any incarnation may take over, including the same one with a lower number.
    """

    def __init__(self, silence: float):
        self._silence = silence
        self._run_id: str | None = None
        self._seq = -1
        self._last = 0.0

    @property
    def run_id(self) -> str | None:
        """The incarnation followed now; None before the first."""
        return self._run_id

    def silent(self, now: float) -> bool:
        """Return whether any sender may take over: none is followed, or its last accepted message is too old."""
        return self._run_id is None or now - self._last > self._silence

    def accept(self, run_id: str, seq: int, now: float) -> FollowVerdict:
        """Check one message that arrived at `now`, in seconds on any monotonic clock."""
        if not self.silent(now):
            if run_id != self._run_id:
                return "foreign"
            if seq <= self._seq:
                return "out of order"
        self._run_id, self._seq, self._last = run_id, seq, now
        return "ok"


class AgeEstimate:
    """Estimates the age of messages from the sender's clock, without synchronised clocks. The class is pure.

    Arrival time minus sender time is the unknown clock offset plus the delay. Its running minimum is the offset plus
    the shortest delay, so the excess over the minimum is age. The minimum rises by `drift`, so that drifting clocks do
    not make every message look old. It does not adapt to a longer delay, because messages queued during an outage must
    be recognised as old.
    """

    # Quartz clocks disagree by tens of parts per million.
    def __init__(self, drift: float = 1e-4, implausible: float = 1.0):
        self._drift = drift
        self._implausible = implausible
        self._offset: float | None = None
        self._at = 0.0

    def reset(self) -> None:
        """Forget the offset, for another process with another clock."""
        self._offset = None

    def plausible(self, sent: float, arrived: float) -> bool:
        """Return False if the sender's clock seems to have jumped ahead, so that all later messages would look old.

        The other possible cause is that all earlier messages were late by more than the limit.
        """
        return self._offset is None or arrived - sent > self._offset - self._implausible

    def observe(self, sent: float, arrived: float) -> None:
        """Record a message sent at `sent` (sender's clock) that arrived at `arrived` (own clock), in seconds."""
        offset = arrived - sent
        if self._offset is not None:
            offset = min(offset, self._offset + self._drift * max(0.0, arrived - self._at))
        self._offset, self._at = offset, max(arrived, self._at)

    def age(self, sent: float, now: float) -> float:
        """Return the seconds since `sent` beyond the shortest delay seen; 0 before the first observation."""
        return 0.0 if self._offset is None else max(0.0, now - sent - self._offset)


@dataclass(frozen=True, slots=True)
class Received(Generic[M]):
    """An accepted message."""

    message: M
    arrived: float
    """Seconds on this process's monotonic clock."""
    sent: float | None
    """Seconds on the sender's clock, if the message contains them."""


class Inbox(Generic[M]):
    """Checks the messages of one topic. It never raises; rejected messages are counted in `bus.bad`."""

    def __init__(
        self,
        bus: Bus,
        topic: Topic,
        *,
        states: int | None = None,
        inputs: int | None = None,
        sent: Callable[[M], float] | None = None,
        capacity: int = 256,
        arrived: threading.Condition | None = None,
    ):
        """Subscribe to a topic.

        Args:
            bus: the bus.
            topic: the topic.
            states, inputs: the plant's dimensions; None to leave them unchecked.
            sent: returns the sender's time of a message, for its age.
            capacity: messages kept between two reads; beyond it the oldest are lost.
            arrived: notified of every message, so that a thread can wait for several inboxes.
        """
        self.topic = topic
        self.follower = Follower(bus.config.bus.follow_silence)
        self._mailbox: Mailbox = bus.queue(topic, capacity, arrived)
        self._bad = bus.bad
        self._dimensions = None if states is None or inputs is None else (states, inputs)
        self._sent = sent
        self._ages = AgeEstimate()

    def __len__(self) -> int:
        """Number of messages to be taken, valid or not."""
        return len(self._mailbox)

    def take(self) -> Received[M] | None:
        """Return the newest acceptable message since the last call; never block.

        All messages are checked, so an invalid message after a valid one does not hide it.
        """
        newest = None
        for delivery in self._mailbox.drain():
            newest = self._check(delivery) or newest
        return newest

    def take_all(self) -> list[Received[M]]:
        """Return all acceptable messages since the last call, in order; never block."""
        checked = (self._check(delivery) for delivery in self._mailbox.drain())
        return [received for received in checked if received is not None]

    def wait(self, timeout_s: float) -> Received[M] | None:
        """Do the same as `take`, but wait up to `timeout_s` for an acceptable message."""
        newest = self.take()
        deadline = clock.now() + timeout_s
        while newest is None:
            delivery = self._mailbox.get(deadline - clock.now())
            if delivery is None:
                return None
            newest = self._check(delivery)
            newest = self.take() or newest
            if clock.now() >= deadline:
                # This also ends a stream of messages that must not be accepted.
                break
        return newest

    def age(self, received: Received[M], now: float) -> float:
        """Return the seconds since the message was sent, beyond the shortest delay from this sender."""
        return 0.0 if received.sent is None else self._ages.age(received.sent, now)

    def forget_ages(self) -> None:
        """Reset the age estimate. Use it when the next message is known to have the shortest delay."""
        self._ages.reset()

    def undelayed(self, received: Received[M]) -> float:
        """Return the arrival time for the shortest delay from this sender, in seconds."""
        return received.arrived - self.age(received, received.arrived)

    def _check(self, delivery: Delivery) -> Received[M] | None:
        arrived = delivery.received_ns * 1e-9
        try:
            message = cast(M, codec.decode(self.topic, delivery.payload))
            if self._dimensions is not None:
                codec.check_dimensions(self.topic, message, *self._dimensions)
        except codec.BadMessage as error:
            self._bad.count(self.topic.name, error.reason, error.detail)
            return None
        sent = None if self._sent is None else self._sent(message)
        followed = self.follower.run_id
        leapt = sent is not None and message.run_id == followed and not self._ages.plausible(sent, arrived)
        # After a silence the sender's clock is accepted as it is, so that the sender is not rejected permanently.
        if leapt and not self.follower.silent(arrived):
            self._bad.count(self.topic.name, "implausible time", f"sent at {sent} s by {message.run_id}")
            return None
        accept = self.follower.accept
        verdict = "ok" if self.topic.shared else accept(message.run_id, message.seq, arrived)
        if verdict != "ok":
            self._bad.count(
                self.topic.name,
                verdict,
                f"{message.seq} of {message.run_id}, following {followed or 'no sender'}",
            )
            return None
        if sent is not None:
            if message.run_id != followed:
                self._ages.reset()
                if followed is not None:
                    log.info("%s now follows %s instead of %s", self.topic.name, message.run_id, followed)
            self._ages.observe(sent, arrived)
        return Received(message, arrived, sent)
