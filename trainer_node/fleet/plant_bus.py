"""One trainer's place on many plants' buses: each has its keys and its counters, all share two sessions."""

from __future__ import annotations

import contextlib
import logging
import queue
import threading
from types import TracebackType

import zenoh

from node_runtime.bus.session import connect
from node_runtime.bus.zenoh_bus import Bus, Payload
from node_runtime.config.sections import Config
from protocol import topics
from protocol.topics import Topic

log = logging.getLogger(__name__)


class SharedSessions:
    """The two sessions of a process, control and bulk, and one thread that sends the bulk of all its buses.

    A context manager; entering waits for the router.

    Raises on entering:
        OpenInterrupted: `stop` was set first.
        ConfigError: the endpoint is none.
    """

    def __init__(self, config: Config, process: str, stop: threading.Event):
        self._config, self._process, self.stop = config, process, stop
        self._outgoing: queue.SimpleQueue[tuple[PlantBus, Topic, Payload] | None] = queue.SimpleQueue()
        self._sender = threading.Thread(target=self._send, name="bulk", daemon=True)

    def post(self, bus: PlantBus, topic: Topic, payload: Payload) -> None:
        """Leave a bus's message to the thread that sends bulk."""
        self._outgoing.put((bus, topic, payload))

    def _send(self) -> None:
        while (item := self._outgoing.get()) is not None:
            bus, topic, payload = item
            try:
                bus.send(topic, payload)
            except Exception:
                # Whatever one plant's message did, the others' are to be sent.
                log.exception("a message of %s at %s was not sent", bus.config.name, topic.name)

    def _leave(self) -> None:
        self.control.close()
        self.bulk.close()

    def __enter__(self) -> SharedSessions:
        self.control, self.bulk = connect(self._config, self.stop, self._process, 2)
        self._sender.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        # Leaving a link that is full and dead could take long, and the process must end nevertheless.
        leaving = threading.Thread(target=self._leave, name="leave", daemon=True)
        leaving.start()
        leaving.join(2.0)
        self._outgoing.put(None)
        self._sender.join(0.5)


class PlantBus(Bus):
    """`Bus` of the plant `config.name` on sessions that others use too; closing it leaves them open."""

    def __init__(self, config: Config, process: str, run_id: str, sessions: SharedSessions):
        super().__init__(config, process, run_id, sessions.stop)
        self._shared = sessions

    def open(self) -> None:
        """Declare what this process publishes for this plant."""
        self._control, self._bulk = self._shared.control, self._shared.bulk
        for topic in topics.ALL:
            if topic.writer == self.process:
                self._publisher(topic)

    def _post(self, topic: Topic, payload: Payload) -> None:
        self._shared.post(self, topic, payload)

    def send(self, topic: Topic, payload: Payload) -> None:
        """Send what was posted; for the thread that does so."""
        self._send_one(topic, payload)

    def close(self, drain_s: float = 2.0) -> None:
        """Send what is left, and take back all that was declared."""
        if self._closed or self._bulk is None:
            return
        self.flush(drain_s)
        with self._lock:
            self._closed = True
        for declared in (*self._entities, *self._publishers.values()):
            # The session may be gone already.
            with contextlib.suppress(zenoh.ZError):
                declared.undeclare()
