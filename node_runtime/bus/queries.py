"""Queries between processes and their answers, which are sent in fragments like other large messages."""

from __future__ import annotations

import contextlib
import logging
import queue
import threading
from collections.abc import Callable
from typing import Any

import zenoh

from node_runtime.bus.fragments import Fragmenter, Reassembler
from node_runtime.bus.lanes import Lanes
from node_runtime.bus.mailbox import Delivery, Mailbox
from node_runtime.realtime import clock
from node_runtime.rejected import RejectedMessages
from protocol import topics
from protocol.messages import counter_name
from protocol.topics import LARGEST_MESSAGE, LARGEST_QUESTION

log = logging.getLogger(__name__)

PENDING_QUERIES = 32

Handler = Callable[[dict[str, str]], list[bytes]]
"""Maps the parameters of a query to the payloads of its answer. Raises `ValueError` for an error of the sender."""


class Queries:
    """Answers queries of one process, one at a time in a thread of its own, and sends queries for one plant."""

    def __init__(
        self,
        lanes: Lanes,
        plant: str,
        fragmenter: Fragmenter,
        bad: RejectedMessages,
        count: Callable[[str], int],
    ):
        """`bad` counts refused queries; `count` counts failures to send and returns their number."""
        self._lanes, self._plant, self._fragmenter, self._bad, self._count = (
            lanes,
            plant,
            fragmenter,
            bad,
            count,
        )
        self._pending: queue.Queue[tuple[zenoh.Query, str, Handler] | None] = queue.Queue(PENDING_QUERIES)
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None

    def close(self) -> None:
        """Answer no more queries."""
        with contextlib.suppress(queue.Full):
            self._pending.put_nowait(None)
        if self._thread is not None:
            self._thread.join(0.5)

    def serve(self, name: str, handler: Handler) -> zenoh.Queryable[None]:
        """See `Bus.serve`."""

        def arrived(query: zenoh.Query) -> None:
            # A router limits payloads only, and a query has none.
            if len(str(query.parameters)) > LARGEST_QUESTION:
                self._bad.count(name, "oversized question")
                query.drop()
                return
            try:
                self._pending.put_nowait((query, name, handler))
            except queue.Full:
                self._bad.count(name, "too many queries")
                query.drop()

        with self._lock:
            if self._thread is None:
                self._thread = threading.Thread(target=self._answer, name="queries", daemon=True)
                self._thread.start()
        callback = zenoh.handlers.Callback(arrived, indirect=False)
        return self._lanes.session("bulk").declare_queryable(
            topics.below(self._plant, name), callback, complete=True
        )

    def _answer(self) -> None:
        while (item := self._pending.get()) is not None:
            query, name, handler = item
            pairs: Any = query.parameters  # the type stub does not know the conversion to dict
            parameters: dict[str, str] = dict(pairs)
            with query:
                try:
                    payloads = handler(parameters)
                except ValueError as error:
                    self._bad.count(name, "bad query", str(error))
                    query.reply_err(str(error))
                    continue
                try:
                    for payload in payloads:
                        for part in self._fragmenter.split(payload):
                            query.reply(topics.below(self._plant, name), part)
                except zenoh.ZError:
                    self._count("answers_not_sent")

    def ask(self, name: str, parameters: dict[str, str], timeout_s: float) -> list[bytes]:
        """See `Bus.ask`."""
        answers = Mailbox(f"answers from {name}", capacity=10_000)
        done = threading.Event()
        reassembler = Reassembler(2 * LARGEST_MESSAGE, self._bad)

        def arrived(reply: zenoh.Reply) -> None:
            if reply.ok is None:
                error = reply.err
                detail = "" if error is None else error.payload.to_bytes()[:300].decode(errors="replace")
                self._bad.count(name, "answered with an error", detail)
            elif len(reply.ok.payload) > LARGEST_MESSAGE:
                self._bad.count(
                    name, "oversized", f"{len(reply.ok.payload)} bytes, at most {LARGEST_MESSAGE}"
                )
            else:
                whole = reassembler.whole(name, reply.ok.payload.to_bytes(), LARGEST_MESSAGE)
                if whole is not None:
                    answers.put(Delivery(str(reply.ok.key_expr), whole, clock.now_ns()))

        try:
            self._lanes.session("bulk").get(
                zenoh.Selector(topics.below(self._plant, name), parameters),
                zenoh.handlers.Callback(arrived, done.set, indirect=False),
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=timeout_s,
                congestion_control=zenoh.CongestionControl.BLOCK,
                priority=zenoh.Priority.DATA,
            )
        except zenoh.ZError as error:
            if self._count(counter_name("not asked", name)) == 1:
                log.warning("%s could not be asked: %s", name, error)
            return []
        deadline = clock.now() + timeout_s + 0.2
        while not done.wait(min(0.1, max(0.0, deadline - clock.now()))):
            if self._lanes.stop.is_set() or clock.now() >= deadline:
                break
        reassembler.end()
        return [delivery.payload for delivery in answers.drain()]
