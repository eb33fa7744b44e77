"""The bus: raw payloads between processes, over Zenoh.

Two client sessions to one router. *Control* (states, commands) is dropped rather than queued, sent at once,
at real-time priority. *Bulk* (weights, logs) blocks when the link is full, so it has a session and a thread
of its own, and a full link never delays a command; what is large travels in pieces. Receiving threads only
copy the payload into a bounded mailbox: a slow reader loses its own oldest messages and stalls nobody.
"""

from __future__ import annotations

import contextlib
import itertools
import logging
import queue
import threading
import time
from collections.abc import Callable
from typing import Any

import zenoh

from node_runtime.bus.batches import Gathered, Gathering, Separating, size_of
from node_runtime.bus.fragments import Assembler, split
from node_runtime.bus.mailbox import Delivery, Latest, Mailbox, Sink
from node_runtime.bus.session import OpenInterrupted, connect, session_config
from node_runtime.config.sections import Config
from node_runtime.realtime import clock
from node_runtime.rejected import BadMessages
from protocol import codec, topics
from protocol.messages import Message
from protocol.topics import Topic

log = logging.getLogger(__name__)

BULK_MESSAGES = 2000
BULK_BYTES = 256 * 1024 * 1024
PENDING_QUERIES = 32
LARGEST = max(topic.max_bytes for topic in topics.ALL)
LARGEST_QUESTION = 4096
"""Characters of its parameters."""

Handler = Callable[[dict[str, str]], list[bytes]]
Payload = bytes | list[Gathered]

__all__ = ["Bus", "Delivery", "Handler", "Latest", "Mailbox", "OpenInterrupted", "session_config"]


class Bus:
    """One process's place on the bus of one plant. A context manager; `open` waits for the router.

    Everything may be called from any thread. Nothing here raises because of what arrives.
    """

    def __init__(self, config: Config, process: str, run_id: str, stop: threading.Event | None = None):
        """`stop`: when set, a pending `open` gives up with `OpenInterrupted`."""
        self.config = config
        self.process = process
        self.run_id = run_id
        self.bad = BadMessages()
        """Where this process counts what it does not obey, and the bus what it does not deliver."""
        self._stop = stop or threading.Event()
        self._control: zenoh.Session | None = None
        self._bulk: zenoh.Session | None = None
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._lock = threading.Lock()
        self._outgoing: queue.SimpleQueue[tuple[Topic, Payload] | None] = queue.SimpleQueue()
        self._gathering = Gathering(run_id)
        self._in_pieces = itertools.count()
        self._outgoing_count = 0
        self._outgoing_bytes = 0
        self._idle = threading.Condition(self._lock)
        self._counts: dict[str, int] = {}
        self._boxes: list[Mailbox] = []
        self._threads: list[threading.Thread] = []
        self._queries: queue.Queue[tuple[zenoh.Query, str, Handler] | None] = queue.Queue(PENDING_QUERIES)
        self._entities: list[Any] = []
        self._closed = False

    # -- opening and closing -----------------------------------------------------------------------------

    def open(self) -> None:
        """Connect to the router at `config.bus.endpoint`, waiting for it for ever.

        Raises:
            OpenInterrupted: the stop event was set first.
            ConfigError: the endpoint is none.
        """
        if self._control is not None:
            raise RuntimeError("this bus is open already")
        self._control, self._bulk = connect(self.config, self._stop, self.process, 2)
        for topic in topics.ALL:
            if topic.writer == self.process:
                self._publisher(topic)
        self._start(self._send_bulk, "bulk")
        self._start(self._answer, "queries")

    def close(self, drain_s: float = 2.0) -> None:
        """Send what is left of the bulk lane, for at most `drain_s`, and leave. Safe to call twice."""
        if self._closed or self._control is None or self._bulk is None:
            self._closed = True
            return
        self.flush(drain_s)
        with self._lock:
            self._closed = True
        self._outgoing.put(None)
        with contextlib.suppress(queue.Full):
            self._queries.put_nowait(None)
        sessions = (self._control, self._bulk)

        def leave() -> None:
            for session in sessions:
                session.close()

        # Leaving a link that is full and dead could take long, and the process must end nevertheless.
        leaving = threading.Thread(target=leave, name="leave", daemon=True)
        leaving.start()
        leaving.join(drain_s)
        for thread in self._threads:
            thread.join(0.5)

    def __enter__(self) -> Bus:
        self.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def connected(self) -> bool:
        """Whether both sessions have the router at this moment."""
        return all(s is not None and bool(list(s.info.routers_zid())) for s in (self._control, self._bulk))

    # -- publishing --------------------------------------------------------------------------------------

    def publish(self, topic: Topic, message: Message) -> None:
        """Send one message: control at once, bulk by the bulk thread. Never waits for a reader."""
        payload = codec.encode(message)
        if len(payload) > topic.max_bytes:
            self._count(f"not sent, oversized {topic.name}")
            return
        gathered = topics.gathers(topic, self.config.rate)
        if topic.lane == "control":
            self._put(topic, payload)
        elif not gathered:
            self._enqueue(topic, payload)
        if gathered:
            self._gather(topic, payload)

    def matched(self, topic: Topic) -> bool:
        """Whether somebody is subscribed to this topic; a message sent before that reaches nobody."""
        status: Any = self._publisher(topic).matching_status  # the stub says bool, the object says more
        return bool(status.matching)

    def flush(self, timeout_s: float) -> bool:
        """Wait until the bulk lane is empty; False when it is not after `timeout_s`."""
        with self._lock:
            self._enqueue_gathered()
        with self._idle:
            return self._idle.wait_for(lambda: self._outgoing_count == 0, timeout_s)

    def _put(self, topic: Topic, payload: bytes) -> None:
        try:
            self._publisher(topic).put(payload)
        except zenoh.ZError as error:
            if not self._closed and self._count(f"not sent, error {topic.name}") == 1:
                log.warning("%s could not be sent: %s", topic.name, error)
            return
        self._count(f"sent {topic.lane}")

    def _enqueue(self, topic: Topic, payload: bytes) -> None:
        with self._lock:
            # What was published before goes out before.
            self._enqueue_gathered()
            self._enqueue_one(topic, payload, len(payload))

    def _gather(self, topic: Topic, payload: bytes) -> None:
        with self._lock:
            if self._gathering.add(topic, payload, clock.now_ns()):
                self._enqueue_gathered()

    def _enqueue_gathered(self) -> None:
        """With the lock held: what has gathered is one message more to send. Its parts count one by one if lost."""
        gathered, size = self._gathering.take()
        if gathered:
            self._enqueue_one(topics.BATCH[self.process], gathered, size, len(gathered))

    def _enqueue_one(self, topic: Topic, payload: Payload, size: int, messages: int = 1) -> None:
        """With the lock held."""
        if self._closed:
            return
        if self._outgoing_count >= BULK_MESSAGES or self._outgoing_bytes + size > BULK_BYTES:
            self._counts["bulk overflow"] = self._counts.get("bulk overflow", 0) + messages
            return
        self._outgoing_count += 1
        self._outgoing_bytes += size
        self._post(topic, payload)

    def _post(self, topic: Topic, payload: Payload) -> None:
        """Leave a message to the thread that sends bulk."""
        self._outgoing.put((topic, payload))

    def _send_bulk(self) -> None:
        while (item := self._outgoing.get()) is not None:
            self._send_one(*item)

    def _send_one(self, topic: Topic, payload: Payload) -> None:
        size = len(payload) if isinstance(payload, bytes) else size_of(payload)
        # Put together, and cut in pieces, here, where nobody waits for it.
        whole = payload if isinstance(payload, bytes) else self._gathering.encode(payload)
        for part in split(whole, self.run_id, next(self._in_pieces)):
            self._put(topic, part)
        with self._idle:
            self._outgoing_count -= 1
            self._outgoing_bytes -= size
            self._idle.notify_all()

    def _publisher(self, topic: Topic) -> zenoh.Publisher:
        publisher = self._publishers.get(topic.name)
        if publisher is not None:
            return publisher
        control = topic.lane == "control"
        session = self._session(topic)
        with self._lock:
            if topic.name not in self._publishers:
                direct = control and topics.gathers(topic, self.config.rate)
                name = self.config.name
                self._publishers[topic.name] = session.declare_publisher(
                    topic.direct_key(name) if direct else topic.key(name),
                    congestion_control=zenoh.CongestionControl.DROP
                    if control
                    else zenoh.CongestionControl.BLOCK,
                    priority=zenoh.Priority.REAL_TIME if control else zenoh.Priority.DATA,
                    express=control,
                )
            return self._publishers[topic.name]

    def _session(self, topic: Topic | None = None) -> zenoh.Session:
        session = self._control if topic is not None and topic.lane == "control" else self._bulk
        if session is None:
            raise RuntimeError("the bus is not open; call open() first")
        return session

    # -- receiving ---------------------------------------------------------------------------------------

    def latest(self, topic: Topic) -> Latest:
        """Follow a topic's newest message only."""
        latest = Latest(topic.name)
        self._follow(topic, latest.put)
        return latest

    def queue(self, topic: Topic, capacity: int = 1000) -> Mailbox:
        """Follow all messages of a topic; beyond `capacity` unread ones the oldest is dropped and counted."""
        mailbox = self._mailbox(topic.name, capacity)
        self._follow(topic, mailbox.put)
        return mailbox

    def everything(self, capacity: int = 100_000) -> Mailbox:
        """Follow all that is published below `tandem/<plant>/`, this process's own messages included.

        What travelled gathered in a `Batch` is here one by one, as if it had travelled alone.
        """
        mailbox = Separating("everything", capacity, self.bad)
        with self._lock:
            self._boxes.append(mailbox)
        self._subscribe(self._session(), topics.everything(self.config.name), mailbox.put)
        return mailbox

    def _follow(self, topic: Topic, sink: Sink) -> None:
        session, name = self._session(topic), self.config.name
        self._subscribe(session, topic.key(name), sink, topic)
        if topic.lane == "control" and topics.gathers(topic, self.config.rate):
            self._subscribe(session, topic.direct_key(name), sink, topic)

    def _mailbox(self, name: str, capacity: int) -> Mailbox:
        mailbox = Mailbox(name, capacity)
        with self._lock:
            self._boxes.append(mailbox)
        return mailbox

    def _subscribe(self, session: zenoh.Session, key: str, sink: Sink, only: Topic | None = None) -> None:
        """`only`: what `key` is the key of, None where it covers many."""
        bad = self.bad
        plain = None if only is None else only.key(self.config.name)
        assembler = Assembler(2 * (LARGEST if only is None else only.max_bytes), bad)

        # Runs on the link's receiving thread, so it must be short: a stamp, a copy, an append.
        def arrived(sample: zenoh.Sample) -> None:
            received_ns = time.monotonic_ns()
            key = plain or str(sample.key_expr)
            topic = only or topics.topic_of(key)
            limit = LARGEST if topic is None else topic.max_bytes
            payload = sample.payload
            size = len(payload)
            if size > limit:
                name = "unknown topic" if topic is None else topic.name
                bad.count(name, "oversized", f"{size} bytes, at most {limit}")
            elif sample.kind == zenoh.SampleKind.PUT:
                arrived_now = payload.to_bytes()
                whole = arrived_now if topic is None else assembler.whole(topic.name, arrived_now, limit)
                if whole is not None:
                    sink(Delivery(key, whole, received_ns))

        callback = zenoh.handlers.Callback(arrived, indirect=False)
        self._entities.append(session.declare_subscriber(key, callback))

    # -- questions and answers ---------------------------------------------------------------------------

    def serve(self, name: str, handler: Handler) -> None:
        """Answer queries at `tandem/<plant>/<name>`: `handler(parameters)` gives the payloads to send back.

        The handler runs in the bus's own query thread, one query at a time. A `ValueError` from it is the
        asker's fault: counted, named once, answered with the text. Queries beyond a few pending ones go
        unanswered.
        """
        key = f"{topics.PREFIX}/{self.config.name}/{name}"

        def arrived(query: zenoh.Query) -> None:
            # A router's limits are for payloads, and a question has none.
            if len(str(query.parameters)) > LARGEST_QUESTION:
                self.bad.count(name, "oversized question")
                query.drop()
                return
            try:
                self._queries.put_nowait((query, key, handler))
            except queue.Full:
                self.bad.count(name, "too many queries")
                query.drop()

        callback = zenoh.handlers.Callback(arrived, indirect=False)
        self._entities.append(self._session().declare_queryable(key, callback, complete=True))

    def ask(self, name: str, parameters: dict[str, str], timeout_s: float) -> list[bytes]:
        """Payloads of all answers to a query at `tandem/<plant>/<name>`; [] when nobody answers in time."""
        key = f"{topics.PREFIX}/{self.config.name}/{name}"
        answers = Mailbox(f"answers from {name}", capacity=10_000)
        done = threading.Event()
        assembler = Assembler(2 * LARGEST, self.bad)

        def arrived(reply: zenoh.Reply) -> None:
            if reply.ok is None:
                error = reply.err
                detail = "" if error is None else error.payload.to_bytes()[:300].decode(errors="replace")
                self.bad.count(name, "answered with an error", detail)
            elif len(reply.ok.payload) > LARGEST:
                self.bad.count(name, "oversized", f"{len(reply.ok.payload)} bytes, at most {LARGEST}")
            else:
                whole = assembler.whole(name, reply.ok.payload.to_bytes(), LARGEST)
                if whole is not None:
                    answers.put(Delivery(str(reply.ok.key_expr), whole, time.monotonic_ns()))

        try:
            self._session().get(
                zenoh.Selector(key, parameters),
                zenoh.handlers.Callback(arrived, done.set, indirect=False),
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=timeout_s,
                congestion_control=zenoh.CongestionControl.BLOCK,
                priority=zenoh.Priority.DATA,
            )
        except zenoh.ZError as error:
            if self._count(f"not asked {name}") == 1:
                log.warning("%s could not be asked: %s", name, error)
            return []
        deadline = clock.now() + timeout_s + 0.2
        while not done.wait(min(0.1, max(0.0, deadline - clock.now()))):
            if self._stop.is_set() or clock.now() >= deadline:
                break
        assembler.end()
        return [delivery.payload for delivery in answers.drain()]

    def _answer(self) -> None:
        while (item := self._queries.get()) is not None:
            query, key, handler = item
            pairs: Any = query.parameters  # the stub lacks that it converts to a dict
            parameters: dict[str, str] = dict(pairs)
            with query:
                try:
                    payloads = handler(parameters)
                except ValueError as error:
                    self.bad.count(key.split("/", 2)[2], "bad query", str(error))
                    query.reply_err(str(error))
                    continue
                try:
                    for payload in payloads:
                        for part in split(payload, self.run_id, next(self._in_pieces)):
                            query.reply(key, part)
                except zenoh.ZError:
                    self._count("answers not sent")

    # -- figures -----------------------------------------------------------------------------------------

    def counters(self) -> dict[str, int]:
        """What was sent, what was lost here and why, bad messages included; for `Health`."""
        with self._lock:
            counts = dict(self._counts)
            boxes = list(self._boxes)
        for box in boxes:
            if box.overflow:
                counts[f"overflow {box.name}"] = counts.get(f"overflow {box.name}", 0) + box.overflow
        return counts | self.bad.counters()

    def _count(self, name: str) -> int:
        with self._lock:
            self._counts[name] = self._counts.get(name, 0) + 1
            return self._counts[name]

    def _start(self, target: Callable[[], None], name: str) -> None:
        thread = threading.Thread(target=target, name=name, daemon=True)
        self._threads.append(thread)
        thread.start()
