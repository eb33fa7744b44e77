"""A file that continues where it stopped when the disk was full.

The MCAP library writes to this as to any file. Data that the disk refuses stay in memory, in order, and are tried
again. When there is room again, the file continues at the byte where it stopped, and is never corrupt.
"""

from __future__ import annotations

import os
from collections import deque
from pathlib import Path

from mcap.writer import CompressionType, Writer

from run_log.errors import LogError, LogExistsError

PENDING_LIMIT = 64 * 1024 * 1024


class Sink:
    """An append-only file, created exclusively, with bounded memory for data that cannot be written yet.

    Args:
        path: a file that does not exist yet; missing folders above it are created.
        patient: False raises `LogError` if the file cannot be created; True tries again.

    Raises:
        LogExistsError: `path` exists already.
        LogError: not patient, and the file cannot be created.
    """

    def __init__(self, path: str | Path, *, patient: bool = False, limit: int = PENDING_LIMIT):
        self.path = Path(path)
        self.limit = limit
        self.error: str | None = None
        """Error of the last attempt to write; None if it succeeded."""
        self.errors = 0
        self.written = 0
        """Bytes that the operating system has accepted."""
        self._pending: deque[memoryview] = deque()
        self._length = 0
        self._fd: int | None = None
        self._open()
        if self._fd is None and not patient:
            raise LogError(self.error)

    @property
    def pending(self) -> int:
        """Bytes that wait for the disk."""
        return self._length - self.written

    def tell(self) -> int:
        return self._length

    def write(self, data: bytes) -> None:
        if data:
            self._pending.append(memoryview(data))
            self._length += len(data)

    def flush(self) -> bool:
        """Write the waiting data as far as the disk accepts it; return True if nothing waits any more."""
        if self._fd is None:
            try:
                self._open()
            except LogExistsError as error:
                self._failed(str(error))
            if self._fd is None:
                return False
        try:
            while self._pending:
                taken = os.write(self._fd, self._pending[0])
                self.written += taken
                if taken == len(self._pending[0]):
                    self._pending.popleft()
                else:
                    self._pending[0] = self._pending[0][taken:]
        except OSError as error:
            self._failed(
                f"{self.path}: cannot be written: {error.strerror}; {self.pending} bytes wait in memory"
            )
            return False
        self.error = None
        return True

    def close(self) -> bool:
        """Write as much as possible and close; return True if the file holds everything."""
        whole = self.flush()
        if self._fd is not None:
            try:
                os.fsync(self._fd)
                os.close(self._fd)
            except OSError as error:
                self._failed(f"{self.path}: cannot be closed: {error.strerror}")
                whole = False
            self._fd = None
        return whole

    def _open(self) -> None:
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._fd = os.open(self.path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        except FileExistsError as error:
            if not os.path.lexists(self.path):
                self._failed(f"{self.path}: cannot be created: {error.filename} is not a folder")
                return
            raise LogExistsError(
                f"{self.path}: exists already, and a log never overwrites a file; choose another name"
            ) from error
        except OSError as error:
            self._failed(f"{self.path}: cannot be created: {error.strerror}")

    def _failed(self, text: str) -> None:
        self.error = text
        self.errors += 1


def mcap_writer(sink: Sink, chunk_bytes: int) -> Writer:
    """Options of every log: compressed chunks of about this size, and checksums over everything."""
    # The MCAP library only uses write, tell and flush of a file.
    return Writer(sink, chunk_size=chunk_bytes, compression=CompressionType.ZSTD, enable_data_crcs=True)
