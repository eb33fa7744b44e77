"""The queue of messages on a bus's bulk lane: bounded, in order, and in batches if a loop is fast."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable
from functools import partial

from node_runtime.bus.batches import Waiting, encode_batch
from protocol import topics
from protocol.topics import Topic

MAX_MESSAGES = 2000
MAX_BYTES = 256 * 1024 * 1024


class BulkQueue:
    """The messages of one bus for the sending thread. Any thread may call; no call waits for the link."""

    def __init__(
        self,
        run_id: str,
        batch: Topic | None,
        post: Callable[[Callable[[], None]], None],
        send: Callable[[Topic, bytes], None],
    ):
        """`batch`: the process's topic for batches; `post`: hands a call of `send` to the sending thread."""
        self._run_id, self._batch_topic, self._post, self._send = run_id, batch, post, send
        self._waiting: list[Waiting] = []
        self._waiting_bytes = 0
        self._batches = itertools.count()
        self._empty = threading.Condition()
        self._messages = 0
        self._bytes = 0
        self._closed = False
        self.overflow = 0
        """Number of messages dropped because the queue was full."""

    def put(self, topic: Topic, payload: bytes) -> None:
        """Send a message by itself, after the batch of the messages published before it."""
        with self._empty:
            self._put_batch()
            self._put(topic, len(payload), 1, lambda: payload)

    def put_batched(self, topic: Topic, payload: bytes, now_ns: int) -> None:
        """Add a message, published at `now_ns` (monotonic), to the batch, and send the batch when it is due."""
        with self._empty:
            self._waiting.append(Waiting(topic.name, now_ns, payload))
            self._waiting_bytes += len(payload)
            waited_ns = now_ns - self._waiting[0].published_ns
            if waited_ns >= topics.BATCH_S * 1e9 or self._waiting_bytes > topics.BATCH_BYTES:
                self._put_batch()

    @property
    def unsent(self) -> int:
        """Number of messages in the queue or being sent."""
        with self._empty:
            return self._messages + len(self._waiting)

    def flush(self, timeout_s: float) -> bool:
        """Wait until all messages are sent; False if they are not after `timeout_s`."""
        with self._empty:
            self._put_batch()
            return self._empty.wait_for(lambda: self._messages == 0, timeout_s)

    def close(self) -> None:
        """Accept no more messages."""
        with self._empty:
            self._closed = True

    def _put_batch(self) -> None:
        """Queue the waiting messages as one batch, with the lock held. If it is dropped, its parts count one by one."""
        waiting, size = self._waiting, self._waiting_bytes
        self._waiting, self._waiting_bytes = [], 0
        if waiting and self._batch_topic is not None:
            # The number is assigned at sending, so a dropped batch leaves no gap.
            def encode() -> bytes:
                return encode_batch(self._run_id, next(self._batches), waiting)

            self._put(self._batch_topic, size, len(waiting), encode)

    def _put(self, topic: Topic, size: int, messages: int, encode: Callable[[], bytes]) -> None:
        """Queue one message, with the lock held."""
        if self._closed:
            return
        if self._messages >= MAX_MESSAGES or self._bytes + size > MAX_BYTES:
            self.overflow += messages
            return
        self._messages += 1
        self._bytes += size
        self._post(partial(self._send_one, topic, size, encode))

    def _send_one(self, topic: Topic, size: int, encode: Callable[[], bytes]) -> None:
        """Send one message in the sending thread."""
        try:
            self._send(topic, encode())
        finally:
            with self._empty:
                self._messages -= 1
                self._bytes -= size
                self._empty.notify_all()
