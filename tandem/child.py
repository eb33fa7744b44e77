"""The main module of a process of `tandem run`: a tandem command that ends when its supervisor does.

    python -P -m tandem.child SUPERVISOR_PID COMMAND...

A killed supervisor cannot stop its children, so they watch it.
"""

from __future__ import annotations

import os
import select
import signal
import sys
import threading
import time

GRACE_S = 5.0


def end_with(parent: int, grace_s: float = GRACE_S) -> None:
    """End this process when the process `parent` ends: first by SIGTERM, then by force."""
    try:
        handle = os.pidfd_open(parent)
    except ProcessLookupError:
        raise SystemExit(1) from None
    if os.getppid() != parent:  # it died, and its number belongs to another process
        raise SystemExit(1)

    def watch() -> None:
        poll = select.poll()
        poll.register(handle, select.POLLIN)
        poll.poll()
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(grace_s)
        os.kill(os.getpid(), signal.SIGKILL)

    threading.Thread(target=watch, name="supervisor", daemon=True).start()


def main() -> int:
    # The supervisor's own priority is not inherited: each process requests what it needs.
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    end_with(int(sys.argv[1]))
    from tandem.cli import main as tandem

    return tandem(sys.argv[2:])


if __name__ == "__main__":
    sys.exit(main())
