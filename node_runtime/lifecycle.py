"""Start and end of a process: run ids, signals, exit codes."""

from __future__ import annotations

import logging
import os
import signal
import threading
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

from node_runtime.bus.session import OpenInterrupted
from node_runtime.config.strict import ConfigError
from node_runtime.realtime import clock

log = logging.getLogger(__name__)

EXIT_MISCONFIGURED = 2
SIGNALS = (signal.SIGINT, signal.SIGTERM)

# Ctrl-C reaches a whole process group, and a supervisor may repeat it at once. Both count as one signal.
REPEATED_SIGNAL_S = 1.0


def new_run_id(process: str) -> str:
    """Return a new id for this incarnation of `process`."""
    return f"{process}-{uuid.uuid4().hex[:12]}"


def run_process(body: Callable[[threading.Event], int], stop: threading.Event | None = None) -> int:
    """Run `body` with an event that is set by signals, and return its exit code.

    `stop` is that of `stopped_by_signals`. The result is 2 after a `ConfigError`, and 0 if the process was told to stop
    before there was a router.
    """
    with stopped_by_signals(stop) as stopping:
        try:
            return body(stopping)
        except ConfigError as error:
            log.error("%s", error)
            return EXIT_MISCONFIGURED
        except OpenInterrupted as interrupted:
            log.info("%s", interrupted)
            return 0


@contextmanager
def stopped_by_signals(stop: threading.Event | None = None) -> Iterator[threading.Event]:
    """Let SIGINT and SIGTERM set the yielded event. Another signal more than a second later ends the process at once.

    Outside the main thread signals are not handled, and the owner of `stop` sets the event.
    """
    event = stop or threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield event
        return
    first: list[float] = []

    def handle(number: int, _frame: FrameType | None) -> None:
        if not first:
            first.append(clock.now())
            # Event.set in a handler could wait for a lock that the interrupted code holds.
            threading.Thread(target=event.set, name="stop", daemon=True).start()
        elif clock.now() - first[0] > REPEATED_SIGNAL_S:
            signal.signal(number, signal.SIG_DFL)
            os.kill(os.getpid(), number)

    before = {number: signal.signal(number, handle) for number in SIGNALS}
    try:
        yield event
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
