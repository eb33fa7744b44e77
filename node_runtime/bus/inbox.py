"""From raw payloads to messages that may be obeyed: decoded, of the right size, in order, of known age."""

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
    """Whom to obey on one topic; pure, no clock of its own.

    The first process incarnation seen is followed, with rising sequence numbers. After `silence` seconds in
    which none of its messages was accepted, any incarnation may take over, the same one with a lower number
    too.
    """

    def __init__(self, silence: float):
        self._silence = silence
        self._run_id: str | None = None
        self._seq = -1
        self._last = 0.0

    @property
    def run_id(self) -> str | None:
        """The incarnation followed now, None before the first."""
        return self._run_id

    def silent(self, now: float) -> bool:
        """Whether nobody is followed, or none of its messages was accepted for so long that anybody may take over."""
        return self._run_id is None or now - self._last > self._silence

    def accept(self, run_id: str, seq: int, now: float) -> FollowVerdict:
        """Judge one message that arrived at `now`, seconds on any monotonic clock."""
        if not self.silent(now):
            if run_id != self._run_id:
                return "foreign"
            if seq <= self._seq:
                return "out of order"
        self._run_id, self._seq, self._last = run_id, seq, now
        return "ok"


class AgeEstimate:
    """How old a message is, from the sender's own clock, without synchronised clocks; pure.

    Arrival minus sender time is the unknown offset between the clocks plus the delay. Its running minimum is
    the offset plus the shortest delay seen, so what lies above the minimum is age. The minimum leaks upwards
    by `drift`, so that two clocks that drift apart do not make everything look old. It does not follow a
    longer delay: what piled up during an outage must come out old.
    """

    # Quartz clocks disagree by tens of parts per million.
    def __init__(self, drift: float = 1e-4, implausible: float = 1.0):
        self._drift = drift
        self._implausible = implausible
        self._offset: float | None = None
        self._at = 0.0

    def reset(self) -> None:
        """Forget the offset: another process, another clock."""
        self._offset = None

    def plausible(self, sent: float, arrived: float) -> bool:
        """False when the sender's clock seems to have leapt ahead: all that follows would look old.

        Or the messages so far were all late, by more than that; either shows in what follows.
        """
        return self._offset is None or arrived - sent > self._offset - self._implausible

    def observe(self, sent: float, arrived: float) -> None:
        """Take note of a message sent at `sent` (sender's clock) and arrived at `arrived` (ours); seconds."""
        offset = arrived - sent
        if self._offset is not None:
            offset = min(offset, self._offset + self._drift * max(0.0, arrived - self._at))
        self._offset, self._at = offset, max(arrived, self._at)

    def age(self, sent: float, now: float) -> float:
        """Seconds since `sent`, beyond the shortest delay ever seen; 0 before the first observation."""
        return 0.0 if self._offset is None else max(0.0, now - sent - self._offset)


@dataclass(frozen=True, slots=True)
class Received(Generic[M]):
    """A message that may be obeyed, as far as its age allows."""

    message: M
    arrived: float
    """Seconds on this process's monotonic clock."""
    sent: float | None
    """Seconds on the sender's clock, where the message says."""


class Inbox(Generic[M]):
    """One topic's messages, checked. Never raises; whatever is wrong is counted in `bus.bad`."""

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
        """`states`, `inputs`: the plant's dimensions, None to leave them unchecked. `sent`: the sender's time
        in a message, for its age. A flood beyond `capacity` between two reads loses the oldest. `arrived`: notified of
        every message, for who waits for any of several inboxes."""
        self.topic = topic
        self.follower = Follower(bus.config.bus.follow_silence)
        self._mailbox: Mailbox = bus.queue(topic, capacity, arrived)
        self._bad = bus.bad
        self._dimensions = None if states is None or inputs is None else (states, inputs)
        self._sent = sent
        self._ages = AgeEstimate()

    def __len__(self) -> int:
        """Messages that wait to be taken, whatever they are worth."""
        return len(self._mailbox)

    def take(self) -> Received[M] | None:
        """The newest message that arrived since the last call and may be obeyed; never blocks.

        All that arrived is looked at, so that garbage behind a good message does not hide it.
        """
        newest = None
        for delivery in self._mailbox.drain():
            newest = self._check(delivery) or newest
        return newest

    def take_all(self) -> list[Received[M]]:
        """All that arrived since the last call and may be obeyed, in order; never blocks."""
        checked = (self._check(delivery) for delivery in self._mailbox.drain())
        return [received for received in checked if received is not None]

    def wait(self, timeout_s: float) -> Received[M] | None:
        """Like `take`, waiting up to `timeout_s` for a message that may be obeyed."""
        newest = self.take()
        deadline = clock.now() + timeout_s
        while newest is None:
            delivery = self._mailbox.get(deadline - clock.now())
            if delivery is None:
                return None
            newest = self._check(delivery)
            newest = self.take() or newest
            if clock.now() >= deadline:
                # Also where what must not be obeyed never ends.
                break
        return newest

    def age(self, received: Received[M], now: float) -> float:
        """Seconds since the message was sent, beyond the shortest delay seen from this sender."""
        return 0.0 if received.sent is None else self._ages.age(received.sent, now)

    def forget_ages(self) -> None:
        """Take the next message for as quick as any: who reads them knows that the shortest delay was none."""
        self._ages.reset()

    def undelayed(self, received: Received[M]) -> float:
        """When the message would have arrived with the shortest delay seen from its sender; seconds."""
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
        # After silence it is taken for what the sender's clock says now: it must not be shut out for ever.
        if leapt and not self.follower.silent(arrived):
            self._bad.count(self.topic.name, "implausible time", f"sent at {sent} s by {message.run_id}")
            return None
        accept = self.follower.accept
        verdict = "ok" if self.topic.shared else accept(message.run_id, message.seq, arrived)
        if verdict != "ok":
            self._bad.count(
                self.topic.name,
                verdict,
                f"{message.seq} of {message.run_id}, following {followed or 'nobody'}",
            )
            return None
        if sent is not None:
            if message.run_id != followed:
                self._ages.reset()
                if followed is not None:
                    log.info("%s now follows %s instead of %s", self.topic.name, message.run_id, followed)
            self._ages.observe(sent, arrived)
        return Received(message, arrived, sent)
