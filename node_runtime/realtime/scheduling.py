"""Measures that make a Python loop punctual: real-time priority, one BLAS thread, no garbage collection in a step."""

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
"""SCHED_FIFO priority of processes that read the whole bus: below the loops and above all ordinary processes. A reader
without a core fills its link, and the router then holds back the messages of all processes."""
WAKE_LATENCY = "/dev/cpu_dma_latency"
"""Linux keeps the wake-up latency, in microseconds, that was written to this file while the file is open."""


def one_blas_thread() -> AbstractContextManager[object]:
    """Limit BLAS to one thread. For small matrices more threads wait for each other and may round differently."""
    return threadpoolctl.threadpool_limits(limits=1)


@contextmanager
def quick_handover() -> Iterator[None]:
    """Let a computing thread of this process give way to a waiting thread after 50 us instead of 5 ms.

    The bus's receiving thread needs the interpreter for a moment per message. If it waits 5 ms each time, it reads 200
    messages a second. A faster sender then fills the link, and the router holds back all messages, including commands.
    """
    interval = sys.getswitchinterval()
    sys.setswitchinterval(5e-5)
    try:
        yield
    finally:
        sys.setswitchinterval(interval)


@contextmanager
def awake(wanted: bool = True, device: str = WAKE_LATENCY) -> Iterator[str]:
    """Keep the cores of this machine from sleeping, so that waking takes microseconds. This costs power.

    Without permission, log a warning and yield it as a text for `Health.note`; otherwise yield "".
    """
    if not wanted:
        yield ""
        return
    try:
        file = open(device, "r+b", buffering=0)  # noqa: SIM115 - the result depends on whether it opens
    except OSError as error:
        note = f"{device} cannot be opened ({error.strerror}); cores may sleep between slots and wake late"
        log.warning("%s. Run as root or give access to it, or set realtime.awake = never.", note)
        yield note
        return
    with file:
        file.write(struct.pack("@i", 0))
        yield ""


def core_for(config: Config, process: str, allowed: set[int]) -> int | None:
    """Return the core for the loop of "controller" or "plant"; None if the scheduler decides.

    A loop that moves to another core finds its data in no cache. At 1 kHz this happens in most slots.

    Raises:
        ConfigError: `realtime.cores` does not name two cores, or names one that this process may not use.
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
    """Keep the calling thread, and threads that it starts inside, on one core; None does nothing."""
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
    """Return the text for `Health.note`."""
    return "" if core is None else f"its loop stays on core {core}"


@contextmanager
def punctual(priority: int, *, keep_awake: bool = False, silent: bool = False) -> Iterator[str]:
    """Make the calling thread, and all threads that it starts afterwards, punctual.

    Enter it before opening the bus, whose threads inherit the priority. Without the privilege the loop runs at ordinary
    priority; a warning is then logged and yielded as a text for `Health.note`. Otherwise "" is yielded.

    Args:
        priority: SCHED_FIFO priority 1 to 99; 0 for ordinary scheduling.
        keep_awake: see `awake`.
        silent: suppresses the warning, for a process beside others that log it.
    """
    before = (os.sched_getscheduler(0), os.sched_getparam(0))
    collecting = gc.isenabled()
    note = _raise_priority(priority, silent)
    with awake(keep_awake) as sleepy, one_blas_thread(), quick_handover():
        try:
            yield "; ".join(filter(None, (note, sleepy)))
        finally:
            # Undo the settings of a `GarbageCollection` inside.
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
    """Runs garbage collection between steps, where there is time, instead of inside a step.

    A full collection in a large process stops all its threads for 100 ms. In a process that reads the bus, this stops
    the router's messages to all processes.
    """

    def __init__(self, every: int = 20):
        """`every`: calls of `idle` between two collections."""
        self._every = every
        self._calls = 0

    @classmethod
    def at(cls, period: float) -> GarbageCollection:
        """Return one for a loop with this period in seconds: every 20 steps, and at most five times a second."""
        return cls(max(20, math.ceil(0.2 / period)))

    def begin(self) -> None:
        """Exclude all present objects from the search, and stop automatic collection."""
        gc.collect()
        gc.freeze()
        gc.disable()

    def idle(self) -> None:
        """Collect if it is due. Call it once per step, after all urgent work."""
        self._calls += 1
        if self._calls % self._every == 0:
            # Collect young objects only. A full collection would also visit all stored data, such as 20,000 samples,
            # and take longer than a fast loop's period.
            gc.collect(1)
