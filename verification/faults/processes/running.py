"""A process of a run, and the record of a run: received messages and injected events."""

from __future__ import annotations

import os
import signal
import subprocess
from dataclasses import dataclass, field
from pathlib import Path

from node_runtime.realtime import clock


@dataclass(frozen=True)
class Heard:
    """One message that the suite received on the bus."""

    at: float
    """Seconds on the monotonic clock."""
    topic: str
    payload: bytes


@dataclass(frozen=True)
class Event:
    """An event that was injected into the run."""

    at: float
    """Seconds on the monotonic clock."""
    text: str
    concerns: tuple[str, ...] = ()
    """Processes, or "disk"."""
    whole_again: bool = False
    """The hurt process is well from now on."""


@dataclass
class Running:
    """One process, with the times of its start and kill; seconds on the monotonic clock."""

    name: str
    words: list[str]
    environment: dict[str, str]
    output: Path
    popen: subprocess.Popen[bytes] | None = None
    started: list[float] = field(default_factory=list)
    killed: list[float] = field(default_factory=list)
    restart_at: float | None = None

    def start(self) -> None:
        with self.output.open("ab") as output:
            self.popen = subprocess.Popen(
                self.words,
                stdin=subprocess.PIPE,
                stdout=output,
                stderr=subprocess.STDOUT,
                env=os.environ | self.environment,
                process_group=0,
            )
        self.started.append(clock.now())

    @property
    def alive(self) -> bool:
        return self.popen is not None and self.popen.poll() is None

    def signal(self, number: signal.Signals) -> None:
        if self.popen is not None and self.alive:
            os.killpg(self.popen.pid, number)

    def said(self) -> str:
        return self.output.read_text(errors="replace") if self.output.exists() else ""
