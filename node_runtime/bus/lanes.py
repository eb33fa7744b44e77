"""The two links of a process to its router, one per lane, and the thread that sends bulk messages."""

from __future__ import annotations

import logging
import queue
import threading
from collections.abc import Callable

import zenoh

from node_runtime.bus.session import connect
from node_runtime.config.sections import Config
from protocol.topics import Lane

log = logging.getLogger(__name__)


class Lanes:
    """A control session and a bulk session of one process, which several plants' buses can share. A context manager.

    *Control* messages (states, commands) are dropped rather than queued, and sent at once at real-time priority. *Bulk*
    messages (weights, logs) block when the link is full. They have a session and a thread of their own, so a full link
    never delays a command.
    """

    def __init__(self, config: Config, process: str, stop: threading.Event | None = None):
        """`stop`: when it is set, a pending `open` ends with `OpenInterrupted`."""
        self._config, self._process = config, process
        self.stop = stop or threading.Event()
        self._sessions: dict[Lane, zenoh.Session] = {}
        self._outgoing: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._sender = threading.Thread(target=self._send, name="bulk", daemon=True)

    def open(self) -> None:
        """Connect to the router at `config.bus.endpoint`, waiting for it without a time limit.

        Raises:
            OpenInterrupted: the stop event was set.
            ConfigError: the endpoint is not valid, our certificate cannot be used, or either side refuses the other.
        """
        if self._sessions:
            raise RuntimeError("these lanes are open already")
        control, bulk = connect(self._config, self.stop, self._process, 2)
        self._sessions = {"control": control, "bulk": bulk}
        self._sender.start()

    def close(self, drain_s: float = 2.0) -> None:
        """Close the sessions within about `drain_s` seconds. Safe to call twice, and before `open`."""
        if not self._sender.is_alive():
            return
        self._outgoing.put(None)
        # Closing a link that is full and dead can take long. The process must end nevertheless.
        leaving = threading.Thread(target=self._leave, name="leave", daemon=True)
        leaving.start()
        leaving.join(drain_s)
        self._sender.join(0.5)

    def __enter__(self) -> Lanes:
        self.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def session(self, lane: Lane) -> zenoh.Session:
        """Return the session of a lane. Raises `RuntimeError` before `open`."""
        if not self._sessions:
            raise RuntimeError("the bus is not open; call open() first")
        return self._sessions[lane]

    def post(self, send: Callable[[], None]) -> None:
        """Queue a call of `send` for the bulk thread, after all earlier calls."""
        self._outgoing.put(send)

    def _send(self) -> None:
        while (send := self._outgoing.get()) is not None:
            try:
                send()
            except Exception:
                # A failure of one message must not stop the others, which may belong to other plants.
                log.exception("a message was not sent")

    def _leave(self) -> None:
        for session in self._sessions.values():
            session.close()
