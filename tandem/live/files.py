"""The files a run leaves: NAME.mcap (after long, NAME.part2.mcap and so on), NAME.png and the folder NAME.processes.

None is ever overwritten.
"""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import count
from pathlib import Path

from node_runtime.whole_file import require_regular
from run_log.writing.parts import existing_parts
from tandem.terminal import Refused


@dataclass(frozen=True)
class RunFiles:
    """Where one run writes."""

    log: Path
    picture: Path
    folder: Path
    """Configuration and output of every process."""

    @classmethod
    def of(cls, log: Path) -> RunFiles:
        return cls(log, log.with_suffix(".png"), log.with_suffix(".processes"))

    def aside(self, number: int) -> RunFiles:
        """What all are called when they are moved aside: NAME.1.mcap, NAME.1.png and so on."""
        stem = f"{self.log.stem}.{number}"
        log, *others = (self.log.with_name(stem + end) for end in (self.log.suffix, ".png", ".processes"))
        return RunFiles(log, *others)

    @property
    def config(self) -> Path:
        return self.folder / "config.toml"

    def all(self) -> list[Path]:
        return [self.log, self.picture, self.folder, *self.later_parts]

    @property
    def later_parts(self) -> list[Path]:
        """Those of its log, after the first, that are there."""
        return [path for path in existing_parts(self.log) if path != self.log]

    def moves(self, to: RunFiles) -> list[tuple[Path, Path]]:
        """(from, to) of all that is there, when it becomes the files `to`."""
        parts = [
            (path, to.log.with_name(to.picture.stem + path.name.removeprefix(self.log.stem)))
            for path in self.later_parts
        ]
        named = [(self.log, to.log), (self.picture, to.picture), (self.folder, to.folder), *parts]
        return [(old, new) for old, new in named if os.path.lexists(old)]

    def finds_free(self, to: RunFiles) -> bool:
        """Whether nothing has the names `to` yet."""
        return not any(map(os.path.lexists, [*to.all(), *(new for _old, new in self.moves(to))]))


@contextmanager
def claimed(log: Path) -> Iterator[tuple[RunFiles, list[str]]]:
    """Room for a run's files; yields them, and what a person should know about what lay there before.

    What has these names already is moved aside to NAME.1.mcap, NAME.1.png and so on.

    Raises:
        Refused: another run is writing there, the place cannot be written to, or one of the names is not of a file.
    """
    files = RunFiles.of(log)
    if log.suffix in (".png", ".processes"):
        raise Refused(f"{log}: the picture has that name; call the log NAME.mcap")
    if log.is_dir():
        raise Refused(f"{log}: is a folder; name a file")
    try:
        moved = _move_aside(files)
        files.folder.mkdir(parents=True)
        lock = _lock(files.folder)
    except OSError as error:
        raise Refused(f"{error.filename or log}: cannot be written: {error.strerror}") from error
    if lock is None:
        raise Refused(_busy(log))
    try:
        yield files, moved
    finally:
        os.close(lock)


def _move_aside(files: RunFiles) -> list[str]:
    there = [path for path in files.all() if os.path.lexists(path)]
    for path in there:
        if path != files.folder or path.is_symlink() or not path.is_dir():
            require_regular(path)
    if not there:
        return []
    if files.folder in there:
        lock = _lock(files.folder)
        if lock is None:
            raise Refused(_busy(files.log))
        os.close(lock)
    aside = next(names for names in map(files.aside, count(1)) if files.finds_free(names))
    said = []
    for old, new in files.moves(aside):
        old.rename(new)
        if old != files.folder:
            said.append(f"{old} was there already; it is now {new}")
    return said


def _busy(log: Path) -> str:
    return f"{log}: another run is writing it; choose another name with --log"


def _lock(folder: Path) -> int | None:
    """Hold the folder for as long as this process lives; None when another process does."""
    handle = os.open(folder / "lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o644)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(handle)
        return None
    return handle
