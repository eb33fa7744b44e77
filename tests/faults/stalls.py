"""An empty loop that notes when the machine itself kept it waiting: `python stalls.py FILE CORE PRIORITY`.

A virtual machine's cores are taken away now and then. What is late then is late in every loop; the suite tells those
ticks apart from the ones that a fault made late. It runs above everything of Tandem.
"""

from __future__ import annotations

import os
import sys
import time

PERIOD = 0.01
NOTED = 0.002


def main(path: str, core: int, priority: int) -> None:
    """Append `due late` in seconds on the monotonic clock, whenever it woke more than 2 ms late; until killed."""
    os.sched_setaffinity(0, {core})
    if priority:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    with open(path, "a", buffering=1) as file:
        due = time.monotonic()
        while True:
            due += PERIOD
            time.sleep(max(0.0, due - time.monotonic()))
            late = time.monotonic() - due
            if late > NOTED:
                file.write(f"{due} {late}\n")
                due = time.monotonic()


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))
