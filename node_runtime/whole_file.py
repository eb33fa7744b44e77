"""Files that are whole at every moment: written under another name beside, then renamed.

Only regular files are read, replaced or moved. A name may be given to anything: a device that is replaced is lost to
the whole machine, and a pipe that is opened waits for somebody at its other end.
"""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

KINDS = {
    stat.S_IFDIR: "a folder",
    stat.S_IFLNK: "a link",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFIFO: "a pipe",
    stat.S_IFSOCK: "a socket",
}


def require_regular(path: Path) -> None:
    """Before a file is replaced or moved: raises `OSError` where a folder, link, device or pipe has that name.

    The text for a person is in `strerror`. Where there is nothing, nothing is raised.
    """
    try:
        _require(path, os.lstat(path).st_mode)
    except FileNotFoundError:
        return


@contextmanager
def open_regular(path: Path) -> Iterator[IO[bytes]]:
    """A file to be read; a link to a file is followed.

    Raises:
        OSError: it cannot be opened, or is no regular file. It never waits for one who writes into a pipe.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        _require(path, os.fstat(descriptor).st_mode)
    except OSError:
        os.close(descriptor)
        raise
    with open(descriptor, "rb") as file:
        yield file


def read_regular(path: Path, limit: int = -1) -> bytes:
    """The content of a file, at most `limit` bytes of it; raises as `open_regular`."""
    with open_regular(path) as file:
        return file.read(limit)


def _require(path: Path, mode: int) -> None:
    if not stat.S_ISREG(mode):
        what = KINDS.get(stat.S_IFMT(mode), "something else")
        raise OSError(
            errno.EINVAL, f"it is {what}, and only a regular file is read, replaced or moved", str(path)
        )


def write_whole(path: Path, content: bytes, mode: int = 0o644, durable: bool = False) -> None:
    """Write a file so that who reads it at any moment finds the old one or the new one, whole.

    Two processes may write the same file. One that is killed meanwhile leaves `.NAME.PID.new` behind, which nobody
    reads.

    Args:
        path: the file; folders above it that are missing are made.
        content: all of it.
        mode: its permissions from the first byte on, less what the umask takes.
        durable: a crash of the machine leaves the old one or the new one too. Waits for the disk.

    Raises:
        OSError: it cannot be written, or something else than a regular file has that name. The old file stays.
    """
    require_regular(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    new = path.with_name(f".{path.name}.{os.getpid()}.new")
    # Never into a file that is there already, with whatever permissions.
    new.unlink(missing_ok=True)
    try:
        with open(os.open(new, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
            file.write(content)
            if durable:
                file.flush()
                os.fsync(file.fileno())
        new.replace(path)
    except BaseException:
        new.unlink(missing_ok=True)
        raise
    if durable:
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
