"""What a bus has published on its bulk lane and not sent yet: bounded, in order, in batches where a loop is fast."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import partial

from node_runtime.bus.batches import OutgoingBatch
from node_runtime.realtime import clock
from protocol.topics import Topic

MAX_MESSAGES = 2000
MAX_BYTES = 256 * 1024 * 1024


class BulkQueue:
    """One bus's messages on their way to the thread that sends them. Any thread may call; nobody waits for the link."""

    def __init__(
        self,
        run_id: str,
        batch: Topic | None,
        post: Callable[[Callable[[], None]], None],
        send: Callable[[Topic, bytes], None],
    ):
        """`batch`: the process's own topic for batches; `post`: leaves a call of `send` to the thread that sends."""
        self._batch_topic = batch
        self._batch = OutgoingBatch(run_id)
        self._post, self._send = post, send
        self._empty = threading.Condition()
        self._messages = 0
        self._bytes = 0
        self._closed = False
        self.overflow = 0
        """Messages that found no place here."""

    def put(self, topic: Topic, payload: bytes) -> None:
        """Send a message by itself, after the batch of those that were published before."""
        with self._empty:
            self._put_batch()
            self._put(topic, len(payload), 1, lambda: payload)

    def put_batched(self, topic: Topic, payload: bytes) -> None:
        """Let a message wait for others, and send them all when it is time."""
        with self._empty:
            if self._batch.add(topic, payload, clock.now_ns()):
                self._put_batch()

    def flush(self, timeout_s: float) -> bool:
        """Wait until everything is sent; False when it is not after `timeout_s`."""
        with self._empty:
            self._put_batch()
            return self._empty.wait_for(lambda: self._messages == 0, timeout_s)

    def close(self) -> None:
        """Take nothing more."""
        with self._empty:
            self._closed = True

    def _put_batch(self) -> None:
        """With the lock held: what has waited is one message more to send. Its parts count one by one if lost."""
        waiting, size = self._batch.take()
        if waiting and self._batch_topic is not None:
            self._put(self._batch_topic, size, len(waiting), partial(self._batch.encode, waiting))

    def _put(self, topic: Topic, size: int, messages: int, encode: Callable[[], bytes]) -> None:
        """With the lock held."""
        if self._closed:
            return
        if self._messages >= MAX_MESSAGES or self._bytes + size > MAX_BYTES:
            self.overflow += messages
            return
        self._messages += 1
        self._bytes += size
        self._post(partial(self._send_one, topic, size, encode))

    def _send_one(self, topic: Topic, size: int, encode: Callable[[], bytes]) -> None:
        try:
            # A batch is put together here, where nobody waits for it.
            self._send(topic, encode())
        finally:
            with self._empty:
                self._messages -= 1
                self._bytes -= size
                self._empty.notify_all()
