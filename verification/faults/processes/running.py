"""A process of a run, and what is remembered of a run: what was heard, and what was done to it."""

from __future__ import annotations

import os
import signal
import subprocess
from dataclasses import dataclass, field
from pathlib import Path

from node_runtime.realtime import clock


@dataclass(frozen=True)
class Heard:
    """One message as the suite heard it on the bus."""

    at: float
    """Seconds on the monotonic clock."""
    topic: str
    payload: bytes


@dataclass(frozen=True)
class Event:
    """Something that was done to the run."""

    at: float
    """Seconds on the monotonic clock."""
    text: str
    concerns: tuple[str, ...] = ()
    """Processes, or "disk"."""
    whole_again: bool = False
    """What was hurt is well from now on."""


@dataclass
class Running:
    """One process, and when it was started and killed; seconds on the monotonic clock."""

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
