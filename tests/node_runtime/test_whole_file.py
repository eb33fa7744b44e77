"""A file is whole whenever it is read, has its permissions from the start, and a failure leaves the old one."""

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


def test_a_reader_finds_one_whole_file_or_the_other(tmp_path: Path) -> None:
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
def test_permissions_do_not_come_from_what_lies_there(tmp_path: Path, durable: bool) -> None:
    path = tmp_path / "key"
    for place in (path, path.with_name(f".key.{os.getpid()}.new")):
        place.write_bytes(b"older")
        place.chmod(0o666)
    write_whole(path, b"secret", mode=0o600, durable=durable)
    assert (path.read_bytes(), path.stat().st_mode & 0o777) == (b"secret", 0o600)


def test_a_disk_that_fails_leaves_the_old_file_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "file"
    write_whole(path, b"old", durable=True)

    def full(_descriptor: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        write_whole(path, b"new", durable=True)
    assert [(file.name, file.read_bytes()) for file in tmp_path.iterdir()] == [("file", b"old")]


# -- what is no file -----------------------------------------------------------------------------------------


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
    (tmp_path / "elsewhere").write_bytes(b"somebody else's")
    make(path)
    before = path.lstat()
    with pytest.raises(OSError, match=f"it is {kind}, but only regular files"):
        write_whole(path, b"new")
    assert (path.lstat().st_ino, path.lstat().st_mode) == (before.st_ino, before.st_mode)
    assert (tmp_path / "elsewhere").read_bytes() == b"somebody else's"
    if kind == "a link":
        assert read_regular(path) == b"somebody else's"
    else:
        with pytest.raises(OSError, match=r"only regular files|No such device"):
            read_regular(path)  # at once: nobody writes into the pipe


def test_as_much_of_a_file_is_read_as_is_asked_for(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"0123456789")
    assert read_regular(tmp_path / "file", 4) == b"0123"
    with pytest.raises(FileNotFoundError):
        read_regular(tmp_path / "none")
