"""Folders whose content is believed, because nobody but this user can have written it."""

from __future__ import annotations

import os
import pwd
import stat
from pathlib import Path

from node_runtime.whole_file import KINDS


def make_private(folder: Path) -> None:
    """Make a folder, and those above it that are missing, for this user alone, whatever the umask.

    Raises:
        OSError: one of them cannot be made.
    """
    for path in (*reversed(folder.parents), folder):
        if not path.is_dir():
            path.mkdir(mode=0o700, exist_ok=True)


def why_not_private(folder: Path) -> str | None:
    """Why others may have written what is in a folder, and what to do; None where only this user can have.

    The folder itself must be this user's, no link, and writable by nobody else. Of the folders above it, none may
    belong to a third user or be open to all: he could put another folder in its place. In a folder like /tmp, whose
    sticky bit forbids that, it may lie. Raises `OSError`: the folder is not there.
    """
    reason = why_not_ours(folder, folder.lstat())
    if reason is not None:
        return reason
    for above in folder.resolve().parents:
        status = above.stat()
        if status.st_uid not in (0, os.geteuid()):
            return f"{folder} lies below {above}, which belongs to {_user(status.st_uid)}"
        if status.st_mode & stat.S_IWOTH and not status.st_mode & stat.S_ISVTX:
            return f"{folder} lies below {above}, which everybody can write"
    return None


def why_not_ours(path: Path, status: os.stat_result) -> str | None:
    """Why others may have written a file or folder, by what `lstat` says of it; None where they cannot."""
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
