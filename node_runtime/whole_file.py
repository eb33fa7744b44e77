"""Files that are complete at every moment: written under another name in the same folder, then renamed.

Only regular files are read, replaced or moved. A device that is replaced is lost to the whole machine, and opening a
pipe waits for its other end.
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
    """Raise `OSError` if the name belongs to a folder, link, device or pipe. Call it before replacing or moving a file.

    `strerror` is a text for a person. A missing file is accepted.
    """
    try:
        _require(path, os.lstat(path).st_mode)
    except FileNotFoundError:
        return


@contextmanager
def open_regular(path: Path) -> Iterator[IO[bytes]]:
    """Open a regular file for reading. A link to a file is followed.

    Raises:
        OSError: it cannot be opened or is not a regular file. The call never waits for the writer of a pipe.
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
    """Return the content of a file, at most `limit` bytes; raises as `open_regular` does."""
    with open_regular(path) as file:
        return file.read(limit)


def _require(path: Path, mode: int) -> None:
    if not stat.S_ISREG(mode):
        what = KINDS.get(stat.S_IFMT(mode), "something else")
        raise OSError(
            errno.EINVAL, f"it is {what}, but only regular files are read, replaced or moved", str(path)
        )


def write_whole(path: Path, content: bytes, mode: int = 0o644, durable: bool = False) -> None:
    """Write a file so that a reader at any moment finds either the old or the new content, complete.

    Two processes may write the same file. A process that is killed meanwhile leaves `.NAME.PID.new` behind, which is
    never read.

    Args:
        path: the file; missing folders above it are created.
        content: the whole content.
        mode: permissions from the first byte on, reduced by the umask.
        durable: True waits for the disk, so that a crash of the machine leaves the old or the new file too.

    Raises:
        OSError: it cannot be written, or the name belongs to something other than a regular file. The old file stays.
    """
    require_regular(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    new = path.with_name(f".{path.name}.{os.getpid()}.new")
    # Never write into an existing file, whose permissions may differ.
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
