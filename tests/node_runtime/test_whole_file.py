"""A file is complete whenever it is read and has its permissions from the start; after a failure the old one stays."""

from __future__ import annotations

import errno
import os
import socket
import stat
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from node_runtime.whole_file import read_regular, write_whole


def test_a_reader_finds_the_old_or_the_new_file_complete(tmp_path: Path) -> None:
    path, known = tmp_path / "missing" / "file", [b"a" * 100_000, b"b" * 200_000]
    write_whole(path, known[0])
    stop = threading.Event()

    def write() -> None:
        while not stop.is_set():
            for content in known:
                write_whole(path, content)

    writer = threading.Thread(target=write)
    writer.start()
    try:
        assert all(path.read_bytes() in known for _ in range(300))
    finally:
        stop.set()
        writer.join()
    assert [file.name for file in path.parent.iterdir()] == ["file"]


@pytest.mark.parametrize("durable", [False, True])
def test_permissions_do_not_depend_on_existing_files(tmp_path: Path, durable: bool) -> None:
    path = tmp_path / "key"
    for place in (path, path.with_name(f".key.{os.getpid()}.new")):
        place.write_bytes(b"older")
        place.chmod(0o666)
    write_whole(path, b"secret", mode=0o600, durable=durable)
    assert (path.read_bytes(), path.stat().st_mode & 0o777) == (b"secret", 0o600)


def test_a_failing_disk_leaves_only_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "file"
    write_whole(path, b"old", durable=True)

    def full(_descriptor: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        write_whole(path, b"new", durable=True)
    assert [(file.name, file.read_bytes()) for file in tmp_path.iterdir()] == [("file", b"old")]


# -- anything other than a regular file ----------------------------------------------------------------------


def a_socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(str(path))


@pytest.mark.parametrize(
    ("make", "kind"),
    [
        (Path.mkdir, "a folder"),
        (lambda path: path.symlink_to("elsewhere"), "a link"),
        (os.mkfifo, "a pipe"),
        (a_socket, "a socket"),
        pytest.param(
            lambda path: os.mknod(path, 0o666 | stat.S_IFCHR, os.makedev(1, 3)),
            "a device",
            marks=pytest.mark.skipif(os.geteuid() != 0, reason="only root can make a device"),
        ),
    ],
)
def test_only_a_regular_file_is_replaced_or_read(
    make: Callable[[Path], None], kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # the name of a socket must be short
    path = Path("file")
    (tmp_path / "elsewhere").write_bytes(b"another file")
    make(path)
    before = path.lstat()
    with pytest.raises(OSError, match=f"it is {kind}, but only regular files"):
        write_whole(path, b"new")
    assert (path.lstat().st_ino, path.lstat().st_mode) == (before.st_ino, before.st_mode)
    assert (tmp_path / "elsewhere").read_bytes() == b"another file"
    if kind == "a link":
        assert read_regular(path) == b"another file"
    else:
        with pytest.raises(OSError, match=r"only regular files|No such device"):
            read_regular(path)  # returns at once, although the pipe has no writer


def test_at_most_the_requested_bytes_are_read(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"0123456789")
    assert read_regular(tmp_path / "file", 4) == b"0123"
    with pytest.raises(FileNotFoundError):
        read_regular(tmp_path / "none")
