"""Files that are whole at every moment: written under another name beside, then renamed."""

from __future__ import annotations

import os
from pathlib import Path


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
        OSError: it cannot be written. The old file stays.
    """
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
