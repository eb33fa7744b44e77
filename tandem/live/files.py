"""The files of a run: NAME.mcap (in a long run NAME.part2.mcap and so on), NAME.png and the folder NAME.processes.

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
    """The files of one run."""

    log: Path
    picture: Path
    folder: Path
    """Folder of configuration and output of every process."""

    @classmethod
    def of(cls, log: Path) -> RunFiles:
        return cls(log, log.with_suffix(".png"), log.with_suffix(".processes"))

    @property
    def config(self) -> Path:
        return self.folder / "config.toml"

    def there(self) -> list[Path]:
        """Return the existing files, including all parts of the log."""
        paths = dict.fromkeys([self.log, self.picture, self.folder, *existing_parts(self.log)])
        return [path for path in paths if os.path.lexists(path)]


@contextmanager
def claimed(log: Path) -> Iterator[tuple[RunFiles, list[str]]]:
    """Reserve the files of a run; yield them, and notes for a person on existing files.

    Existing files with these names are renamed to NAME.1.mcap, NAME.1.png and so on.

    Raises:
        Refused: another run is writing there, the folder is not writable, or one of the names is not that of a file.
    """
    files = RunFiles.of(log)
    if log.suffix in (".png", ".processes"):
        raise Refused(f"{log}: the picture gets this name; name the log NAME.mcap")
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
    there = files.there()
    for path in there:
        if path != files.folder or path.is_symlink() or not path.is_dir():
            require_regular(path)
    if files.folder in there:
        lock = _lock(files.folder)
        if lock is None:
            raise Refused(_busy(files.log))
        os.close(lock)
    stem = files.log.stem
    ends = {files.log.suffix, ".png", ".processes", *(path.name.removeprefix(stem) for path in there)}
    aside = next(
        name
        for name in (files.log.with_name(f"{stem}.{number}") for number in count(1))
        if not any(os.path.lexists(f"{name}{end}") for end in ends)
    )
    said = []
    for old in there:
        new = aside.with_name(aside.name + old.name.removeprefix(stem))
        old.rename(new)
        if old != files.folder:
            said.append(f"{old} existed already and was renamed to {new}")
    return said


def _busy(log: Path) -> str:
    return f"{log}: another run is writing this log; choose another name with --log"


def _lock(folder: Path) -> int | None:
    """Hold the folder for as long as this process lives; None if another process does."""
    handle = os.open(folder / "lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o644)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(handle)
        return None
    return handle
