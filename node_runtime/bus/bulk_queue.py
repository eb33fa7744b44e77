"""What a bus has published on its bulk lane and not sent yet: bounded, in order, in batches where a loop is fast."""

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
    """One bus's messages on their way to the thread that sends them. Any thread may call; nobody waits for the link."""

    def __init__(
        self,
        run_id: str,
        batch: Topic | None,
        post: Callable[[Callable[[], None]], None],
        send: Callable[[Topic, bytes], None],
    ):
        """`batch`: the process's own topic for batches; `post`: leaves a call of `send` to the thread that sends."""
        self._run_id, self._batch_topic, self._post, self._send = run_id, batch, post, send
        self._waiting: list[Waiting] = []
        self._waiting_bytes = 0
        self._batches = itertools.count()
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

    def put_batched(self, topic: Topic, payload: bytes, now_ns: int) -> None:
        """Let a message wait for others, published at `now_ns` (monotonic); send them all when it is time."""
        with self._empty:
            self._waiting.append(Waiting(topic.name, now_ns, payload))
            self._waiting_bytes += len(payload)
            waited_ns = now_ns - self._waiting[0].published_ns
            if waited_ns >= topics.BATCH_S * 1e9 or self._waiting_bytes > topics.BATCH_BYTES:
                self._put_batch()

    @property
    def unsent(self) -> int:
        """Messages that are here, or on their way out."""
        with self._empty:
            return self._messages + len(self._waiting)

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
        waiting, size = self._waiting, self._waiting_bytes
        self._waiting, self._waiting_bytes = [], 0
        if waiting and self._batch_topic is not None:
            # Numbered only when it is sent: a batch that finds no place leaves no gap.
            def encode() -> bytes:
                return encode_batch(self._run_id, next(self._batches), waiting)

            self._put(self._batch_topic, size, len(waiting), encode)

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
        """In the thread that sends, where nobody waits for it."""
        try:
            self._send(topic, encode())
        finally:
            with self._empty:
                self._messages -= 1
                self._bytes -= size
                self._empty.notify_all()
