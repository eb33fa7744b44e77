"""The bus: raw payloads between processes, over Zenoh.

A process has two client sessions to one router, one per lane. Large messages are sent in fragments. Receiving threads
only copy the payload into a bounded mailbox, so a slow reader loses its own oldest messages and delays no other reader.
"""

from __future__ import annotations

import contextlib
import logging
import threading
from collections.abc import Callable
from typing import Any

import zenoh

from node_runtime.bus.batches import UnbatchingMailbox
from node_runtime.bus.bulk_queue import BulkQueue
from node_runtime.bus.fragments import Fragmenter, Reassembler
from node_runtime.bus.lanes import Lanes
from node_runtime.bus.mailbox import Delivery, Mailbox
from node_runtime.bus.queries import Handler, Queries
from node_runtime.bus.session import OpenInterrupted, session_config
from node_runtime.config.sections import Config
from node_runtime.realtime import clock
from node_runtime.rejected import RejectedMessages
from protocol import codec, topics
from protocol.messages import Message, counter_name
from protocol.topics import LARGEST_MESSAGE, Topic

log = logging.getLogger(__name__)

__all__ = ["Bus", "Delivery", "Handler", "Mailbox", "OpenInterrupted", "session_config"]


class Bus:
    """The connection of one process to the bus of one plant. A context manager; `open` waits for the router.

    All methods may be called from any thread. Received messages never cause an exception here.
    """

    def __init__(
        self,
        config: Config,
        process: str,
        run_id: str,
        stop: threading.Event | None = None,
        lanes: Lanes | None = None,
    ):
        """Create the bus without connecting.

        Args:
            config: the configuration.
            process: the role of the process.
            run_id: identifies this incarnation of the process.
            stop: when it is set, a pending `open` ends with `OpenInterrupted`.
            lanes: open lanes that other plants' buses share and that outlive this bus; None for lanes of its own.
        """
        self.config = config
        self.process = process
        self.run_id = run_id
        self.bad = RejectedMessages()
        """Counts messages that this process rejects and that the bus does not deliver."""
        self._lanes = lanes or Lanes(config, process, stop)
        self._shared = lanes is not None
        self._lock = threading.Lock()
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._counts: dict[str, int] = {}
        self._boxes: list[Mailbox] = []
        self._declared: list[Any] = []
        self._closed = False
        self._fragmenter = Fragmenter(run_id)
        self._outgoing = BulkQueue(run_id, topics.BATCH.get(process), self._lanes.post, self._send_bulk)
        self._queries = Queries(self._lanes, config.name, self._fragmenter, self.bad, self._count)

    # -- opening and closing -----------------------------------------------------------------------------

    def open(self) -> None:
        """Connect to the router as `Lanes.open` does, unless the lanes are shared, and declare the publishers."""
        if not self._shared:
            self._lanes.open()
        for topic in topics.ALL:
            if topic.writer == self.process:
                self._publisher(topic)

    def close(self, drain_s: float = 2.0) -> None:
        """Send the rest of the bulk lane for at most `drain_s`, and close. Safe to call twice."""
        if self._closed:
            return
        self._outgoing.flush(drain_s)
        self._closed = True
        self._outgoing.close()
        self._queries.close()
        if not self._shared:
            self._lanes.close(drain_s)
            return
        for declared in (*self._declared, *self._publishers.values()):
            # The session may be closed already.
            with contextlib.suppress(zenoh.ZError):
                declared.undeclare()

    def __enter__(self) -> Bus:
        self.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # -- publishing --------------------------------------------------------------------------------------

    def publish(self, topic: Topic, message: Message) -> None:
        """Send one message: control at once, bulk by the bulk thread. Never wait for a reader."""
        payload = codec.encode(message)
        if len(payload) > topic.max_bytes:
            self._count(counter_name("not sent oversized", topic.name))
            return
        if topic.lane == "control":
            self._put(topic, payload)
        if topic.batched_at(self.config.rate):
            self._outgoing.put_batched(topic, payload, clock.now_ns())
        elif topic.lane == "bulk":
            self._outgoing.put(topic, payload)

    def when_heard(self, topic: Topic, call: Callable[[int], None]) -> None:
        """Call `call` whenever `topic` has a subscriber again after having none.

        This happens, for example, after a link was cut and restored; messages sent meanwhile are lost. `call` receives
        the number of messages of the bulk lane that still wait and will be delivered. It runs in a thread of the bus,
        so it must be short.
        """

        def matching(status: zenoh.MatchingStatus) -> None:
            if status.matching:
                call(self._outgoing.unsent)

        self._declared.append(self._publisher(topic).declare_matching_listener(matching))

    def flush(self, timeout_s: float) -> bool:
        """Wait until the bulk lane is empty; False if it is not after `timeout_s`."""
        return self._outgoing.flush(timeout_s)

    def _send_bulk(self, topic: Topic, payload: bytes) -> None:
        for part in self._fragmenter.split(payload):
            self._put(topic, part)

    def _put(self, topic: Topic, payload: bytes) -> None:
        try:
            self._publisher(topic).put(payload)
        except zenoh.ZError as error:
            if not self._closed and self._count(counter_name("not sent error", topic.name)) == 1:
                log.warning("%s could not be sent: %s", topic.name, error)
            return
        self._count(f"sent_{topic.lane}")

    def _publisher(self, topic: Topic) -> zenoh.Publisher:
        publisher = self._publishers.get(topic.name)
        if publisher is not None:
            return publisher
        control = topic.lane == "control"
        session, name = self._lanes.session(topic.lane), self.config.name
        direct = control and topic.batched_at(self.config.rate)
        with self._lock:
            if topic.name not in self._publishers:
                self._publishers[topic.name] = session.declare_publisher(
                    topic.direct_key(name) if direct else topic.key(name),
                    congestion_control=zenoh.CongestionControl.DROP
                    if control
                    else zenoh.CongestionControl.BLOCK,
                    priority=zenoh.Priority.REAL_TIME if control else zenoh.Priority.DATA,
                    express=control,
                )
            return self._publishers[topic.name]

    # -- receiving ---------------------------------------------------------------------------------------

    def queue(
        self, topic: Topic, capacity: int = 1000, arrived: threading.Condition | None = None
    ) -> Mailbox:
        """Subscribe to all messages of a topic. Beyond `capacity` unread ones the oldest is dropped and counted.

        arrived: notified of each message; None for a condition of the mailbox's own.
        """
        mailbox = Mailbox(topic.name, capacity, arrived=arrived)
        self._boxes.append(mailbox)
        session, name = self._lanes.session(topic.lane), self.config.name
        self._subscribe(session, topic.key(name), mailbox, topic)
        if topic.lane == "control" and topic.batched_at(self.config.rate):
            self._subscribe(session, topic.direct_key(name), mailbox, topic)
        return mailbox

    def everything(self, capacity: int = 100_000) -> Mailbox:
        """Subscribe to all messages below `tandem/<plant>/`, including those of this process.

        The messages of a `Batch` are delivered one by one.
        """
        mailbox = UnbatchingMailbox("everything", capacity, self.bad)
        self._boxes.append(mailbox)
        self._subscribe(self._lanes.session("bulk"), topics.everything(self.config.name), mailbox)
        return mailbox

    def _subscribe(
        self, session: zenoh.Session, key: str, mailbox: Mailbox, only: Topic | None = None
    ) -> None:
        """`only` is the topic of `key`; None if the key covers several topics."""
        bad = self.bad
        plain = None if only is None else only.key(self.config.name)
        reassembler = Reassembler(2 * (LARGEST_MESSAGE if only is None else only.max_bytes), bad)

        # This runs in the link's receiving thread, so it must be short.
        def arrived(sample: zenoh.Sample) -> None:
            received_ns = clock.now_ns()
            key = plain or str(sample.key_expr)
            topic = only or topics.topic_of(key)
            limit = LARGEST_MESSAGE if topic is None else topic.max_bytes
            payload = sample.payload
            size = len(payload)
            if size > limit:
                name = "unknown topic" if topic is None else topic.name
                bad.count(name, "oversized", f"{size} bytes, at most {limit}")
            elif sample.kind == zenoh.SampleKind.PUT:
                arrived_now = payload.to_bytes()
                whole = arrived_now if topic is None else reassembler.whole(topic.name, arrived_now, limit)
                if whole is not None:
                    mailbox.put(Delivery(key, whole, received_ns))

        callback = zenoh.handlers.Callback(arrived, indirect=False)
        self._declared.append(session.declare_subscriber(key, callback))

    # -- queries -----------------------------------------------------------------------------------------

    def serve(self, name: str, handler: Handler) -> None:
        """Answer queries at `tandem/<plant>/<name>` with the payloads of `handler(parameters)`.

        The handler runs in the bus's query thread, one query at a time. A `ValueError` from it is an error of the
        sender: it is counted, logged once, and its text is the answer. If too many queries are pending, further ones
        get no answer.
        """
        self._declared.append(self._queries.serve(name, handler))

    def ask(self, name: str, parameters: dict[str, str], timeout_s: float) -> list[bytes]:
        """Return the payloads of all answers to a query at `tandem/<plant>/<name>`; [] without answers in time."""
        return self._queries.ask(name, parameters, timeout_s)

    # -- counters ----------------------------------------------------------------------------------------

    def counters(self) -> dict[str, int]:
        """Return the counters of sent, lost and rejected messages, for `Health`."""
        with self._lock:
            counts = dict(self._counts)
        if self._outgoing.overflow:
            counts["bulk_overflow"] = self._outgoing.overflow
        for box in list(self._boxes):
            if box.overflow:
                name = counter_name("overflow", box.name)
                counts[name] = counts.get(name, 0) + box.overflow
        return counts | self.bad.counters()

    def _count(self, name: str) -> int:
        with self._lock:
            self._counts[name] = self._counts.get(name, 0) + 1
            return self._counts[name]
