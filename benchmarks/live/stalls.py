"""Idle loops that record when the machine itself stalled; every loop is late at such a moment.

A host takes the cores of a virtual machine away at times. One loop runs on each core, above all priorities of Tandem,
and records when it woke late. A tick that the machine made late is thereby distinguished from one that Tandem
made late.

    python stalls.py FILE CORE PRIORITY       is how `watched` starts each
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

PERIOD = 0.002
"""Seconds. A stall shows if a loop should have woken during it, so one longer than this and `NOTED` always shows."""
NOTED = 0.002
ABOVE = 5
"""Difference between their priority and that of the loops."""

Stall = tuple[float, float]
"""When a loop should have woken, and how late it woke; seconds, on the monotonic clock."""


@contextmanager
def watched(path: Path, priority: int) -> Iterator[None]:
    """Record the machine's stalls to `path` while the body runs. priority: SCHED_FIFO of Tandem's loops; 0: none."""
    with ExitStack() as stack:
        for core in sorted(os.sched_getaffinity(0)):
            words = [sys.executable, __file__, str(path), str(core), str(priority + ABOVE if priority else 0)]
            process = subprocess.Popen(words, stderr=subprocess.DEVNULL)
            stack.callback(process.wait)
            stack.callback(process.kill)
        yield


def read(path: Path) -> list[Stall]:
    """Return the recorded stalls in order; an unfinished line is left out."""
    lines = path.read_text().split("\n")[:-1] if path.exists() else []
    return sorted((float(due), float(late)) for due, late in (line.split() for line in lines))


def during(stalls: Sequence[Stall], begin: float, end: float) -> bool:
    """Return whether the machine stalled at some moment between the two."""
    return any(due < end and due + late > begin for due, late in stalls)


def main(path: str, core: int, priority: int) -> None:
    """Run until killed or until the parent ends."""
    parent = os.getppid()
    os.sched_setaffinity(0, {core})
    if priority:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    with open(path, "a", buffering=1) as file:
        due = time.monotonic()
        while os.getppid() == parent:
            due += PERIOD
            time.sleep(max(0.0, due - time.monotonic()))
            late = time.monotonic() - due
            if late > NOTED:
                file.write(f"{due} {late}\n")
                due = time.monotonic()


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))
