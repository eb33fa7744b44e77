"""The table of processes that make up a run, and one running process of it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

TAIL_LINES = 15


@dataclass(frozen=True)
class Process:
    """One row of the table."""

    name: str
    """As in `protocol.topics.PROCESSES`, or "live-view"."""
    command: str
    """The tandem command that it runs."""
    when_it_dies: Literal["end the run", "go on", "restart"]
    ready_s: float
    """Longest time until it reports that it is ready."""
    slow_because: str = ""
    """Reason for a slow start, which a waiting person sees."""
    optional: bool = False
    """Nothing waits for it, and the run continues without it."""


# In the order of starting. The controller comes last: learning starts with its first tick.
TABLE = (
    Process("router", "router", "end the run", 15.0),
    Process("recorder", "record", "go on", 30.0),
    Process("trainer", "trainer", "restart", 60.0, "it loads torch"),
    Process("plant", "plant", "end the run", 30.0),
    Process("controller", "controller", "end the run", 300.0, "its first start compiles the solver"),
)
LIVE = Process("live-view", "live", "go on", 0.0, optional=True)
"""Started beside the table by `tandem run --live`. It publishes nothing, so it cannot report that it is ready."""
# In the order of stopping, with the seconds that each may take. Controller and plant stop together, because an unstable
# plant must not run on after its last command. Recorder and router stop last, so that the others' last messages are
# logged.
STOP_S = (
    {"controller": 4.0, "plant": 4.0},
    {"trainer": 6.0},
    {"recorder": 15.0, "live-view": 4.0},
    {"router": 4.0},
)


def command_line(command: str, config: Path) -> list[str]:
    """Return the start of a command line for a tandem command that ends with this process and imports nothing from the
    current folder."""
    child = (sys.executable, "-P", "-m", "tandem.child", str(os.getpid()))
    return [*child, command, "--config", str(config)]


class Child:
    """A process of the table, running in a process group of its own, its output in a file."""

    def __init__(self, process: Process, config: Path, folder: Path, *options: str):
        """config: the TOML file that it reads; folder: for its output; options: further arguments."""
        self.process, self.name = process, process.name
        self.started_at = 0.0
        """Time of the newest start, seconds on the monotonic clock."""
        self._output = folder / f"{process.name}.txt"
        self._command = [*command_line(process.command, config), *options]
        self._running: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Start it, for the first time or again; output is appended."""
        self.started_at = time.monotonic()
        with self._output.open("ab") as output:
            self._running = subprocess.Popen(
                self._command,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                process_group=0,  # Ctrl-C is the supervisor's to handle
            )

    def exit_code(self) -> int | None:
        """None while it runs, and before it was started."""
        return None if self._running is None else self._running.poll()

    def alive(self) -> bool:
        return self._running is not None and self.exit_code() is None

    def signal(self, number: signal.Signals) -> None:
        """Send a signal to its whole process group, if it runs."""
        if self._running is not None and self.exit_code() is None:
            # Not reaped yet, so the number is still its own.
            os.killpg(self._running.pid, number)

    def wait(self, timeout_s: float) -> None:
        """Wait until it has ended, but at most `timeout_s` seconds."""
        if self._running is not None:
            with suppress(subprocess.TimeoutExpired):
                self._running.wait(timeout_s)

    def how_it_ended(self) -> str:
        """ "exit code 1" or "killed by SIGKILL"."""
        code = self.exit_code()
        if code is not None and code < 0:
            return f"killed by {signal.Signals(-code).name}"
        return f"exit code {code}"

    def last_words(self) -> str:
        """The last lines of its output, indented."""
        try:
            lines = self._output.read_text(errors="replace").splitlines()
        except OSError:
            return ""
        return "\n".join(f"    {text}" for text in lines[-TAIL_LINES:])
