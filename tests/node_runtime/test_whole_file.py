"""A file is whole whenever it is read, has its permissions from the start, and a failure leaves the old one."""

from __future__ import annotations

import errno
import os
import threading
from pathlib import Path

import pytest

from node_runtime.whole_file import write_whole


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
