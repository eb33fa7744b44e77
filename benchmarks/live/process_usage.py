"""The processes of a `tandem run` as the operating system sees them: memory and processor time."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

NAMES = {"record": "recorder"}
PAGE = os.sysconf("SC_PAGE_SIZE")
TICK_S = 1.0 / os.sysconf("SC_CLK_TCK")


def of(supervisor: int) -> Iterator[tuple[str, Path]]:
    """(name, folder in /proc) of `tandem run`, by its pid, and of the processes that it started."""
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        try:
            words = (entry / "cmdline").read_bytes().split(b"\0")
            parent = int(_fields(entry)[1])
        except (OSError, IndexError):
            continue
        if int(entry.name) == supervisor:
            yield "supervisor", entry
        elif parent == supervisor and b"tandem.child" in words:
            command = words[words.index(b"tandem.child") + 2].decode()
            yield NAMES.get(command, command), entry


def resident(supervisor: int) -> dict[str, int]:
    """Resident memory, kB, by process."""
    found = {}
    for name, entry in of(supervisor):
        try:
            found[name] = int((entry / "statm").read_text().split()[1]) * PAGE // 1024
        except (OSError, IndexError):
            continue
    return found


def busy(supervisor: int) -> dict[str, float]:
    """Seconds of processor time so far, by process."""
    found = {}
    for name, entry in of(supervisor):
        try:
            found[name] = _processor_seconds(entry)
        except (OSError, IndexError):
            continue
    return found


def processor_seconds(pid: int) -> float:
    """Seconds of processor time of one process so far."""
    return _processor_seconds(Path(f"/proc/{pid}"))


def _processor_seconds(entry: Path) -> float:
    return sum(map(int, _fields(entry)[11:13])) * TICK_S


def _fields(entry: Path) -> list[str]:
    """Fields of /proc/PID/stat from the state on; earlier fields may contain spaces."""
    return (entry / "stat").read_text().rpartition(")")[2].split()
