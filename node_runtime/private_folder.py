"""Checks of folders whose contents are trusted because only this user can write them."""

from __future__ import annotations

import os
import pwd
import stat
from pathlib import Path

from node_runtime.whole_file import KINDS


def make_private(folder: Path) -> None:
    """Create a folder, and its missing parents, for this user alone, whatever the umask is.

    Raises:
        OSError: a folder cannot be created.
    """
    for path in (*reversed(folder.parents), folder):
        if not path.is_dir():
            path.mkdir(mode=0o700, exist_ok=True)


def why_not_private(folder: Path) -> str | None:
    """Return why others may have written to a folder, and what to do; None if only this user can.

    The folder must belong to this user, must not be a link, and must not be writable by others. No folder above it may
    belong to a third user or be writable by all, because that user could replace the folder. A folder with a sticky
    bit, such as /tmp, is allowed above it. Raises `OSError` if the folder does not exist.
    """
    reason = why_not_ours(folder, folder.lstat())
    if reason is not None:
        return reason
    for above in folder.resolve().parents:
        status = above.stat()
        if status.st_uid not in (0, os.geteuid()):
            return f"{folder} lies below {above}, which belongs to {_user(status.st_uid)}"
        if status.st_mode & stat.S_IWOTH and not status.st_mode & stat.S_ISVTX:
            return f"{folder} lies below {above}, which all users can write to"
    return None


def why_not_ours(path: Path, status: os.stat_result) -> str | None:
    """Return why others may have written a file or folder, given its `lstat`; None if they cannot have."""
    if not (stat.S_ISREG(status.st_mode) or stat.S_ISDIR(status.st_mode)):
        return f"{path} is {KINDS.get(stat.S_IFMT(status.st_mode), 'something else')}"
    if status.st_uid != os.geteuid():
        return f"{path} belongs to {_user(status.st_uid)}"
    if status.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        return f"{path} can be written by others (mode {stat.S_IMODE(status.st_mode):04o}): chmod go-w {path}"
    return None


def _user(number: int) -> str:
    try:
        return pwd.getpwuid(number).pw_name
    except KeyError:
        return f"user {number}"
