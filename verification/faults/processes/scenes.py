"""Environments of a run until its figures are computed: a disk that can fail, a clock that can step.

Each is a context manager. It receives the run's folder and yields what the processes need in their environment and
in their configurations.
"""

from __future__ import annotations

import os
import struct
import subprocess
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from benchmarks.live.ports import free_port
from verification.faults.strangers import stranger


@dataclass(frozen=True)
class Surroundings:
    """Settings that differ for the processes of one run."""

    environment: dict[str, str] = field(default_factory=dict)
    """Variables of all."""
    settings: dict[str, list[str]] = field(default_factory=dict)
    """`section.key=value` of one process, by its name."""


Scene = Callable[[Path], AbstractContextManager[Surroundings]]

DISK, BALLAST, OFFSET, KEYS = "disk", "ballast", "clock.offset", "keys"


@contextmanager
def nothing(folder: Path) -> Iterator[Surroundings]:
    """The usual."""
    yield Surroundings()


@contextmanager
def memory_disk(folder: Path) -> Iterator[Surroundings]:
    """The log is on a small disk of its own, which `fill` can fill."""
    with _mounted(folder, "-t", "tmpfs", "-o", "size=32m", "tmpfs"):
        yield Surroundings()


def fill(folder: Path) -> None:
    """Fill the log's disk, so that nothing more can be written."""
    free = os.statvfs(folder / DISK)
    with (folder / DISK / BALLAST).open("wb") as ballast:
        os.posix_fallocate(ballast.fileno(), 0, free.f_bavail * free.f_frsize)


def empty(folder: Path) -> None:
    """There is room again."""
    (folder / DISK / BALLAST).unlink()


@contextmanager
def real_disk(folder: Path) -> Iterator[Surroundings]:
    """The log is on an ext4 file system of its own, which `write_protect` can make read-only during the run."""
    image = folder / "image"
    with image.open("wb") as file:
        file.truncate(64 * 1024 * 1024)
    subprocess.run(["mkfs.ext4", "-q", str(image)], check=True, capture_output=True)
    with _mounted(folder, "-o", "loop", str(image)):
        yield Surroundings()
    image.unlink()


def write_protect(folder: Path) -> None:
    """Make the file system read-only, for open files too, as Linux does after a disk error."""
    subprocess.run(["mount", "-o", "remount,abort", str(folder / DISK)], check=True, capture_output=True)


@contextmanager
def _mounted(folder: Path, *words: str) -> Iterator[None]:
    place = folder / DISK
    place.mkdir(parents=True, exist_ok=True)
    subprocess.run(["mount", *words, str(place)], check=True, capture_output=True)
    try:
        yield
    finally:
        subprocess.run(["umount", "-l", str(place)], check=True, capture_output=True)


@contextmanager
def own_wall_clock(folder: Path) -> Iterator[Surroundings]:
    """All processes have a wall clock that `step_clock` can step; the machine's own clock does not change."""
    folder.mkdir(parents=True, exist_ok=True)
    library, offset = folder / "clock_shim.so", folder / OFFSET
    source = Path(__file__).with_name("clock_shim.c")
    subprocess.run(["cc", "-O2", "-shared", "-fPIC", "-o", str(library), str(source), "-ldl"], check=True)
    offset.write_bytes(struct.pack("@q", 0))
    yield Surroundings({"LD_PRELOAD": str(library), "TANDEM_CLOCK_OFFSET": str(offset)})


def step_clock(folder: Path, seconds: float) -> None:
    """Step the wall clock of all processes of the run permanently."""
    with (folder / OFFSET).open("r+b") as file:
        file.write(struct.pack("@q", round(seconds * 1e9)))


@contextmanager
def door_with_certificates(folder: Path) -> Iterator[Surroundings]:
    """The router also listens for other machines, by TLS; `stranger` has keys that must be refused or limited."""
    stranger.keys(_made(folder / KEYS))
    router = folder / KEYS / "good" / "router"
    yield Surroundings(
        settings={"router": [f'bus.remote="tls/127.0.0.1:{free_port()}"', f'bus.tls.keys="{router}"']},
    )


def _made(folder: Path) -> Path:
    folder.mkdir(parents=True)
    return folder
