"""Calls functions in separate processes, with limits of time and memory.

A call that crashes, never ends or fills the memory ends its process and nothing else. A process serves one call after
the other, because importing CasADi and torch takes seconds.
"""

from __future__ import annotations

import contextlib
import pickle
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from multiprocessing.connection import Pipe
from pathlib import Path
from resource import getpagesize
from threading import Lock
from time import monotonic
from typing import Any, Literal

import msgspec

from node_runtime.config.sections import Positive, Seconds, Section
from tandem.experiments.study import child_process

POLL_S = 0.2
"""Interval between two checks of memory and time, seconds."""
GIB = 2**30


class Limits(Section, frozen=True):
    """Limits of one run; a run that exceeds them is stopped."""

    seconds: Seconds = 3600.0
    memory_gib: Positive = 4.0
    """Resident memory of the run's process."""


ORDINARY = Limits()


class Failure(msgspec.Struct, frozen=True, kw_only=True):
    """A run without a result."""

    kind: Literal["error", "crash", "time", "memory"]
    """An exception, or the reason why its process ended."""
    text: str
    """One line."""
    traceback: str
    """Traceback; empty without an exception."""
    where: str = ""
    """The worker; empty for this machine."""


class Unwanted(Exception):
    """The result is no longer wanted; the call was stopped."""


class Child:
    """One process. Not to be used by two threads at a time."""

    def __init__(self) -> None:
        self._channel, theirs = Pipe()
        # -P: no import from the current folder. The output of a plant must not mix with that of this process.
        command = [sys.executable, "-P", "-m", child_process.__name__, str(theirs.fileno())]
        self._process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=2, pass_fds=[theirs.fileno()]
        )
        theirs.close()
        self._used = monotonic()

    @property
    def usable(self) -> bool:
        """Whether it can take a call: it runs, and is not about to end because it was idle."""
        return self._process.poll() is None and monotonic() - self._used < child_process.IDLE_S / 2

    def call(
        self,
        function: Callable[..., Any],
        *arguments: Any,
        limits: Limits,
        wanted: Callable[[], bool] = lambda: True,
    ) -> Any:
        """Return the function's value, or a `Failure`.

        function: of a module, because it is pickled by name; wanted: called repeatedly during the call.

        Raises:
            Unwanted: `wanted` returned False.
        """
        ends = monotonic() + limits.seconds
        try:
            self._channel.send_bytes(pickle.dumps((function, arguments)))
            while not self._channel.poll(POLL_S):
                if self._memory() > limits.memory_gib * GIB:
                    self.kill()
                    text = f"stopped: it used more than {limits.memory_gib:g} GiB of memory"
                    return Failure(kind="memory", text=text, traceback="")
                if monotonic() > ends:
                    self.kill()
                    text = f"stopped: it did not end within {limits.seconds:g} s"
                    return Failure(kind="time", text=text, traceback="")
                if not wanted():
                    self.kill()
                    raise Unwanted
            value, raised = pickle.loads(self._channel.recv_bytes())
        except (EOFError, OSError):
            return Failure(kind="crash", text=self._how_it_ended(), traceback="")
        self._used = monotonic()
        return value if raised is None else Failure(kind="error", text=raised[0], traceback=raised[1])

    def kill(self) -> None:
        self._process.kill()
        self._process.wait()

    def end(self) -> None:
        """End the process if it is idle."""
        self._channel.close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(1.0)
        self.kill()

    def _memory(self) -> int:
        """Return the resident memory in bytes; 0 if the process has ended."""
        try:
            pages = Path(f"/proc/{self._process.pid}/statm").read_text().split()[1]
        except (OSError, IndexError):
            return 0
        return int(pages) * getpagesize()

    def _how_it_ended(self) -> str:
        try:
            code = self._process.wait(5.0)
        except subprocess.TimeoutExpired:
            self.kill()
            return "its process closed the connection"
        if code >= 0:
            return f"its process ended with exit code {code}"
        hint = ", perhaps by the system because memory ran out" if -code == signal.SIGKILL else ""
        return f"its process was killed by {signal.Signals(-code).name}{hint}"


class Children:
    """Processes for several threads, each started when it is first needed."""

    def __init__(self) -> None:
        self._idle: list[Child] = []
        self._busy: set[Child] = set()
        self._lock = Lock()
        self._killed = False

    @contextlib.contextmanager
    def one(self) -> Iterator[Child]:
        """Yield a process for one call."""
        child = self._free() or Child()
        with self._lock:
            self._busy.add(child)
            killed = self._killed
        if killed:  # while this one was being started
            child.kill()
        try:
            yield child
        finally:
            with self._lock:
                self._busy.discard(child)
                self._idle.append(child)

    def _free(self) -> Child | None:
        while True:
            with self._lock:
                if not self._idle:
                    return None
                child = self._idle.pop()
            if child.usable:
                return child
            child.end()

    def kill(self) -> None:
        """End all processes. A call in progress then gives a `Failure`."""
        with self._lock:
            self._killed = True
            idle, self._idle = self._idle, []
            busy = list(self._busy)
        for child in busy:
            child.kill()
        for child in idle:
            child.end()
