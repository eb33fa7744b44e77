"""A process that makes runs for another one: `python -P -m tandem.experiments.study.child_process DESCRIPTOR`.

It reads pickled (function, arguments) from the descriptor and writes (value, None), or (None, (line, traceback)) where
the function raised. It ends when the other process does, or after `IDLE_S` without a request.
"""

from __future__ import annotations

import os
import pickle
import queue
import signal
import sys
import traceback
from multiprocessing.connection import Connection
from threading import Thread
from typing import Any

IDLE_S = 120.0


def main() -> int:
    # Ctrl-C on a terminal reaches every process. The parent decides whether a run ends.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    channel = Connection(int(sys.argv[1]))
    requests: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    Thread(target=_listen, args=(channel, requests), daemon=True).start()
    while True:
        try:
            request = requests.get(timeout=IDLE_S)
        except queue.Empty:
            return 0
        channel.send_bytes(pickle.dumps(_answer(request)))


def _listen(channel: Connection, requests: queue.SimpleQueue[bytes]) -> None:
    try:
        while True:
            requests.put(channel.recv_bytes())
    except (EOFError, OSError):
        # The parent has ended. The main thread may be in a run that never ends.
        os._exit(1)


def _answer(request: bytes) -> tuple[Any, tuple[str, str] | None]:
    try:
        function, arguments = pickle.loads(request)
        return function(*arguments), None
    except (Exception, SystemExit) as error:  # noqa: BLE001 - it is told to the parent
        said = " ".join(traceback.format_exception_only(error)[-1].split())
        return None, (said, "".join(traceback.format_exception(error)))


if __name__ == "__main__":
    sys.exit(main())
