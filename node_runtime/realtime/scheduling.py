"""What makes a Python loop punctual: real-time priority, one BLAS thread, no collection inside a step."""

from __future__ import annotations

import gc
import logging
import math
import os
import struct
import sys
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager

import threadpoolctl

from node_runtime.config.sections import Config
from node_runtime.config.strict import ConfigError

log = logging.getLogger(__name__)

READER_PRIORITY = 1
"""SCHED_FIFO priority of what reads everything on the bus: below the loops, above all that is not real-time. A reader
that gets no core fills its link, and then the router waits, with everybody's messages."""
WAKE_LATENCY = "/dev/cpu_dma_latency"
"""Linux holds the wake-up latency, in microseconds, that was written here for as long as the file stays open."""


def one_blas_thread() -> AbstractContextManager[object]:
    """Matrices here are small: more BLAS threads would only wait for each other, and may round otherwise."""
    return threadpoolctl.threadpool_limits(limits=1)


@contextmanager
def quick_handover() -> Iterator[None]:
    """A thread of this process that computes gives way to one that waits after 50 us, instead of after 5 ms.

    For every message that arrives, the bus's receiving thread needs the interpreter for a moment. A reader that
    takes 5 ms for each message reads 200 a second; a faster sender then fills the link, and the router waits with
    everybody's messages, commands too, until there is room.
    """
    interval = sys.getswitchinterval()
    sys.setswitchinterval(5e-5)
    try:
        yield
    finally:
        sys.setswitchinterval(interval)


@contextmanager
def awake(wanted: bool = True, device: str = WAKE_LATENCY) -> Iterator[str]:
    """Keep the cores of this machine from sleeping, so that a wake-up takes microseconds; it costs power.

    Where that is not permitted: one warning, and the text that is yielded, for `Health.note`, says so; else it is "".
    """
    if not wanted:
        yield ""
        return
    try:
        file = open(device, "r+b", buffering=0)  # noqa: SIM115 - whether it opens decides what is yielded
    except OSError as error:
        note = f"{device} cannot be opened ({error.strerror}); cores may sleep between slots and wake late"
        log.warning("%s. Run as root or give access to it, or set realtime.awake = never.", note)
        yield note
        return
    with file:
        file.write(struct.pack("@i", 0))
        yield ""


def core_for(config: Config, process: str, allowed: set[int]) -> int | None:
    """The core on which the loop of "controller" or "plant" stays; None: the scheduler decides.

    A loop that is moved to another core finds its data in no cache there, and at 1 kHz that happens in most slots.

    Raises:
        ConfigError: `realtime.cores` names a core that this process may not use, or not two of them.
    """
    cores, place = config.realtime.cores, ("controller", "plant").index(process)
    if isinstance(cores, list):
        if len(cores) != 2 or cores[place] not in allowed:
            there = ", ".join(map(str, sorted(allowed)))
            raise ConfigError(
                f"realtime.cores = {cores}: write [controller's core, plant's core]; this process may use {there}"
            )
        return cores[place]
    if cores == "any" or not config.fast or len(allowed) < 2:
        return None
    return sorted(allowed)[-1 - place]


@contextmanager
def on_core(core: int | None) -> Iterator[None]:
    """Keep the calling thread, and those it starts inside, on one core; other threads stay free. None: do nothing."""
    if core is None:
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {core})
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def core_note(core: int | None) -> str:
    """For `Health.note`."""
    return "" if core is None else f"its loop stays on core {core}"


@contextmanager
def punctual(priority: int, *, keep_awake: bool = False, silent: bool = False) -> Iterator[str]:
    """Make the calling thread, and all threads it starts from here on, punctual.

    Enter it before the bus opens, whose threads inherit the priority. Without the privilege the loop runs at
    ordinary priority: one warning, and the text that is yielded, for `Health.note`, says so; else it is "".

    Args:
        priority: SCHED_FIFO priority 1 to 99; 0 leaves the scheduler alone.
        keep_awake: see `awake`.
        silent: no warning; for a process beside others that warn.
    """
    before = (os.sched_getscheduler(0), os.sched_getparam(0))
    collecting = gc.isenabled()
    note = _raise_priority(priority, silent)
    with awake(keep_awake) as sleepy, one_blas_thread(), quick_handover():
        try:
            yield "; ".join(filter(None, (note, sleepy)))
        finally:
            # What a `GarbageCollection` inside has set.
            gc.unfreeze()
            if collecting:
                gc.enable()
            if priority and not note:
                os.sched_setscheduler(0, *before)


def _raise_priority(priority: int, silent: bool) -> str:
    if priority == 0:
        return ""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except PermissionError:
        note = f"no privilege for SCHED_FIFO priority {priority}; slots may be late beside other load"
        log.log(
            logging.DEBUG if silent else logging.WARNING,
            "%s. Grant it with CAP_SYS_NICE or an rtprio limit, or set realtime.priority = 0 to go without.",
            note,
        )
        return note
    return ""


class GarbageCollection:
    """Garbage is collected between steps, where there is time, instead of inside one.

    A full collection in a process that has loaded much stops all its threads for 100 ms; in one that reads the bus,
    that stops the router's messages to everybody.
    """

    def __init__(self, every: int = 20):
        """`every`: calls of `idle` between two collections."""
        self._every = every
        self._calls = 0

    @classmethod
    def at(cls, period: float) -> GarbageCollection:
        """For a loop with this period, in seconds: every 20 steps, and at most five times a second."""
        return cls(max(20, math.ceil(0.2 / period)))

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
