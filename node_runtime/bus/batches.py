"""Batches of messages that are not urgent. At 1 kHz, sending a message alone costs more than creating it."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import NamedTuple

from node_runtime.bus.mailbox import Delivery, Mailbox
from node_runtime.realtime import clock
from node_runtime.rejected import RejectedMessages
from protocol import codec, topics
from protocol import messages as m

BATCH_TOPICS = {topic.name for topic in topics.BATCH.values()}


class Waiting(NamedTuple):
    """A message that waits to be sent in a batch."""

    topic: str
    published_ns: int
    """Monotonic clock."""
    payload: bytes


def encode_batch(run_id: str, seq: int, waiting: list[Waiting]) -> bytes:
    """Return the `Batch` of these messages, sent now."""
    now_ns = clock.now_ns()
    parts = [m.Gathered(topic, max(0, now_ns - at), payload) for topic, at, payload in waiting]
    return codec.encode(m.Batch(run_id=run_id, seq=seq, messages=parts))


def unbatch(delivery: Delivery, bad: RejectedMessages) -> Iterator[Delivery]:
    """Yield the messages of a batch as if each had been sent alone; yield any other delivery unchanged.

    The time of arrival of each message precedes that of the batch by the time that the message waited before it was
    sent. A batch that cannot be read is counted and yielded unchanged.
    """
    topic = topics.topic_of(delivery.key)
    if topic is None or topic.name not in BATCH_TOPICS:
        yield delivery
        return
    try:
        batch = codec.decode(topic, delivery.payload)
    except codec.BadMessage as error:
        bad.count(error.topic, error.reason, error.detail)
        yield delivery
        return
    assert isinstance(batch, m.Batch)
    prefix = delivery.key.removesuffix(topic.name)
    for one in batch.messages:
        yield Delivery(prefix + one.topic, one.payload, delivery.received_ns - one.ago_ns)


class UnbatchingMailbox(Mailbox):
    """A mailbox that unpacks batches; its capacity counts batches."""

    def __init__(self, name: str, capacity: int, bad: RejectedMessages):
        """`bad` counts batches that cannot be read."""
        super().__init__(name, capacity)
        self._bad = bad
        self._unbatched: deque[Delivery] = deque()

    def get(self, timeout_s: float = 0.0) -> Delivery | None:
        """Return the oldest message, waiting up to `timeout_s` for one; None if there is none. For one thread only."""
        if not self._unbatched:
            delivery = super().get(timeout_s)
            if delivery is not None:
                self._unbatched.extend(unbatch(delivery, self._bad))
        return self._unbatched.popleft() if self._unbatched else None

    def drain(self) -> list[Delivery]:
        """Return all messages, oldest first. For one thread only."""
        before = list(self._unbatched)
        self._unbatched.clear()
        return before + [one for delivery in super().drain() for one in unbatch(delivery, self._bad)]
