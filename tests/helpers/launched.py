"""One `tandem run` in a separate process, whose output is followed."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

PATIENCE_S = 180.0
"""Limit in seconds that only ends a hang: torch alone loads for half a minute beside four other processes."""
SMALL = {
    "network.hidden": "[16, 16]",
    "trainer.steps": "50",
    "controller.horizon": "30",
    "controller.solver.compile": "never",
}
RUN = [sys.executable, "-P", "-m", "tandem", "run"]
"""Command line of `tandem run`; like the installed command, it imports nothing from the current folder."""


def small(**more: str) -> list[str]:
    """Arguments for a run that starts quickly."""
    return [word for key, value in (SMALL | more).items() for word in ("--set", f"{key}={value}")]


class Launched:
    """One `tandem run` in a separate process; its output is read line by line."""

    def __init__(self, folder: Path, *arguments: str):
        self.folder = folder
        self.said: list[str] = []
        self._news = threading.Condition()
        self._popen = subprocess.Popen(
            [*RUN, "--json", "--seconds", "600", "--log", str(folder / "run.mcap"), *arguments],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            cwd=folder,
        )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self._popen.stderr is not None
        for text in self._popen.stderr:
            with self._news:
                self.said.append(text)
                self._news.notify_all()

    def hears(self, text: str, times: int = 1, after: str = "") -> None:
        """Wait until `times` lines contain this text, counted from the first line with `after`."""

        def heard() -> bool:
            begin = next((k for k, line in enumerate(self.said) if after in line), len(self.said))
            return sum(text in line for line in self.said[begin:]) >= times

        with self._news:
            assert self._news.wait_for(heard, PATIENCE_S), self.said

    def signal(self, number: signal.Signals) -> None:
        self._popen.send_signal(number)

    def pids(self, command: str = "") -> list[int]:
        """Return the processes that it started, of one tandem command or of all."""
        config = str(self.folder / "run.processes" / "config.toml").encode()
        found = []
        for entry in Path("/proc").iterdir():
            if not entry.name.isdigit():
                continue
            try:
                words = (entry / "cmdline").read_bytes().split(b"\0")
            except OSError:  # it ended meanwhile
                continue
            if config in words and (not command or command.encode() in words):
                found.append(int(entry.name))
        return found

    def kill(self, command: str) -> None:
        (pid,) = self.pids(command)
        os.kill(pid, signal.SIGKILL)

    def ends(self) -> tuple[int, dict]:
        """Return the exit code, and the JSON object on standard output."""
        assert self._popen.stdout is not None
        hangs = threading.Timer(PATIENCE_S, self._popen.kill)
        hangs.start()
        out = self._popen.stdout.read()
        hangs.cancel()
        code = self._popen.wait(PATIENCE_S)
        self._reader.join(PATIENCE_S)
        assert self.pids() == []
        return code, json.loads(out)

    def close(self) -> None:
        self._popen.kill()
        self._popen.wait()
        for pid in self.pids():
            os.kill(pid, signal.SIGKILL)


@contextmanager
def launched(folder: Path, *arguments: str) -> Iterator[Launched]:
    run = Launched(folder, *arguments)
    try:
        yield run
    finally:
        run.close()
