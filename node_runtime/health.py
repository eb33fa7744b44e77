"""Publishes the state of a process: `Health` twice a second and at every change, `RunInfo` every 5 s."""

from __future__ import annotations

import threading
from collections.abc import Callable
from types import TracebackType

import msgspec

from node_runtime.bus.zenoh_bus import Bus
from node_runtime.config.strict import readable
from protocol import topics
from protocol.messages import Health, ProcessStatus, RunInfo

HEALTH_PERIOD = 0.5
RUN_INFO_EVERY = 10
MAX_RATE = 600.0
"""Largest rate of publications of one `HealthThread`, per second. A thousand publishers then publish within two
seconds, after which a view shows a process as silent."""


class HealthThread:
    """One thread that lets several publishers publish in turn; a context manager.

    Each publishes twice a second, or as often as `MAX_RATE` allows if there are more than three hundred.
    """

    def __init__(self) -> None:
        self._publishers: list[HealthPublisher] = []
        self._lock = threading.Lock()
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run, name="health", daemon=True)

    def add(self, publisher: HealthPublisher) -> None:
        """Start publishing for `publisher`."""
        with self._lock:
            self._publishers.append(publisher)

    def remove(self, publisher: HealthPublisher) -> None:
        """Stop publishing for `publisher`."""
        with self._lock:
            self._publishers.remove(publisher)

    def __enter__(self) -> HealthThread:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._thread.join()

    def _run(self) -> None:
        turn = 0
        while True:
            with self._lock:
                among = len(self._publishers)
                if among:
                    # The lock is held, so that no publisher publishes after its removal.
                    self._publishers[turn % among].publish_turn()
                turn += 1
            if self._end.wait(max(HEALTH_PERIOD / max(1, among), 1.0 / MAX_RATE)):
                return


class HealthPublisher:
    """Publishes the state of one process, from a thread of its own or a shared one. A context manager.

    Any thread may call `set`.
    """

    def __init__(
        self,
        bus: Bus,
        info: RunInfo,
        counters: Callable[[], dict[str, int]] | None = None,
        note: str = "",
        thread: HealthThread | None = None,
    ):
        """Create a publisher.

        Args:
            bus: the bus.
            info: the constant facts about the process.
            counters: returns the process's own counters, which are added to the bus's.
            note: a text that precedes all notes.
            thread: a shared thread; None for one of its own.
        """
        self._thread = thread or HealthThread()
        self._shared = thread is not None
        self._bus = bus
        self._info = info
        self._counters = counters
        self._standing_note = note
        self._status: ProcessStatus = "starting"
        self._note = ""
        self._seq = 0
        self._turns = 0
        self._lock = threading.Lock()

    def set(self, status: ProcessStatus, note: str = "") -> None:
        """Set status and note, and publish them if they changed."""
        with self._lock:
            changed = (status, note) != (self._status, self._note)
            self._status, self._note = status, note
        if changed:
            self.publish()

    def publish(self) -> None:
        """Publish the present state now."""
        own = {} if self._counters is None else self._counters()
        counters = self._bus.counters() | own
        with self._lock:
            health = Health(
                run_id=self._bus.run_id,
                seq=self._seq,
                process=self._bus.process,
                status=self._status,
                counters=counters,
                note=readable("; ".join(filter(None, (self._standing_note, self._note)))),
            )
            self._seq += 1
            # Publish inside the lock, so that messages are sent in the order of seq.
            self._bus.publish(topics.HEALTH[self._bus.process], health)

    def publish_turn(self) -> None:
        """Publish `Health`, and `RunInfo` every `RUN_INFO_EVERY` turns."""
        if self._turns % RUN_INFO_EVERY == 0:
            info = msgspec.structs.replace(self._info, seq=self._turns // RUN_INFO_EVERY)
            self._bus.publish(topics.RUN_INFO[self._bus.process], info)
        self._turns += 1
        self.publish()

    def __enter__(self) -> HealthPublisher:
        self._thread.add(self)
        if not self._shared:
            self._thread.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._thread.remove(self)
        if not self._shared:
            self._thread.__exit__()
        if error is not None and kind is not KeyboardInterrupt:
            self.set("failed", f"{type(error).__name__}: {error}")
        elif self._status != "failed":
            self.set("stopping")
