"""What makes a Python loop punctual: real-time priority, one BLAS thread, no collection inside a step."""

from __future__ import annotations

import gc
import logging
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import threadpoolctl

log = logging.getLogger(__name__)


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Matrices here are small: more BLAS threads would only wait for each other, and may round otherwise."""
    with threadpoolctl.threadpool_limits(limits=1):
        yield


@contextmanager
def punctual(priority: int) -> Iterator[str]:
    """Make the calling thread, and all threads it starts from here on, punctual.

    Enter it before the bus opens, whose threads inherit the priority. Without the privilege the loop runs at
    ordinary priority: one warning, and the text that is yielded, for `Health.note`, says so; else it is "".

    Args:
        priority: SCHED_FIFO priority 1 to 99; 0 leaves the scheduler alone.
    """
    before = (os.sched_getscheduler(0), os.sched_getparam(0))
    note = _raise_priority(priority)
    collecting = gc.isenabled()
    interval = sys.getswitchinterval()
    # Another thread of this process gives way to the loop after this long, instead of after 5 ms.
    sys.setswitchinterval(5e-5)
    with one_blas_thread():
        try:
            yield note
        finally:
            sys.setswitchinterval(interval)
            gc.unfreeze()
            if collecting:
                gc.enable()
            if priority and not note:
                os.sched_setscheduler(0, *before)


def _raise_priority(priority: int) -> str:
    if priority == 0:
        return ""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except PermissionError:
        note = f"no privilege for SCHED_FIFO priority {priority}; slots may be late beside other load"
        log.warning(
            "%s. Grant it with CAP_SYS_NICE or an rtprio limit, or set realtime.priority = 0 to go without.",
            note,
        )
        return note
    return ""


class GarbageCollection:
    """Garbage is collected between steps, where there is time, instead of inside one."""

    def __init__(self, every: int = 20):
        """`every`: calls of `idle` between two collections."""
        self._every = every
        self._calls = 0

    def begin(self) -> None:
        """All that exists now stays: take it out of what is searched, and stop automatic collection."""
        gc.collect()
        gc.freeze()
        gc.disable()

    def idle(self) -> None:
        """Called once a step, after all urgent work."""
        self._calls += 1
        if self._calls % self._every == 0:
            # Only what is new: a full collection would also walk all that is remembered, 20,000 samples for
            # instance, and take longer than a fast loop's period.
            gc.collect(1)
