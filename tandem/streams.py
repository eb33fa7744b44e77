"""Standard output and standard error of a command. No failure of their reader makes a command fail.

A pipe may be closed, a disk full, a terminal gone or of another encoding. Text that cannot be written is dropped,
text that cannot be encoded is written as ASCII, and the command continues to its end. Only its exit code reports it.
"""

from __future__ import annotations

import codecs
import errno
import io
import os
import select
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import IO, TextIO

# One cell for one cell, so that columns stay aligned.
_STAND_INS = dict(zip("─━├┤┼●◀▶→–…▁▂▃▄▅▆▇█╸╺•’", "-=||+o<>>-._.:-=+*#==*'", strict=True))


class Sink(io.RawIOBase):
    """Writes to a file descriptor until that fails; later text is dropped."""

    def __init__(self, number: int):
        self.number = number
        self.failed: OSError | None = None
        self._terminal = os.isatty(number)

    def writable(self) -> bool:
        return True

    def fileno(self) -> int:
        return self.number

    def isatty(self) -> bool:
        return self._terminal

    def write(self, data: bytes) -> int:  # type: ignore[override]
        """Write all of `data`, or nothing after a failure."""
        while self.failed is None:
            try:
                return os.write(self.number, data)
            except BlockingIOError:  # another program has set it so
                ready = select.poll()
                ready.register(self.number, select.POLLOUT)
                ready.poll()
            except OSError as error:
                self.failed = error
        return len(data)

    @property
    def lost(self) -> str:
        """Why writing failed; "" if it did not, or if only the reader closed the pipe, which is allowed."""
        if self.failed is None or self._terminal or self.failed.errno == errno.EPIPE:
            return ""
        return os.strerror(self.failed.errno or 0)


class Output:
    """State of standard output."""

    def __init__(self, sink: Sink | None = None):
        self._sink = sink

    def exit_code(self, code: int) -> int:
        """Return the command's own exit code, or 1 if the command succeeded but its output could not be written."""
        sys.stdout.flush()
        lost = self._sink.lost if self._sink is not None else ""
        if lost:
            sys.stderr.write(f"tandem: standard output cannot be written: {lost}\n")
        return code or (1 if lost else 0)


@contextmanager
def never_failing() -> Iterator[Output]:
    """Replace `sys.stdout` and `sys.stderr` by streams that never fail. A closed one becomes the null device."""
    own = sys.stdout, sys.stderr
    if own != (sys.__stdout__, sys.__stderr__):  # a caller has replaced them to capture the output
        yield Output()
        return
    while (
        number := os.open(os.devnull, os.O_RDWR)
    ) <= 2:  # no file of this process may get the number of a closed one
        pass
    os.close(number)
    for stream in own:
        if stream is not None:
            stream.flush()
    sink = Sink(1)
    unfailing = (_text(sink, own[0], lines=sink.isatty()), _text(Sink(2), own[1], lines=True))
    sys.stdout, sys.stderr = unfailing
    try:
        yield Output(sink)
    finally:
        for stream in unfailing:
            stream.flush()
        sys.stdout, sys.stderr = own


def blocked(stream: IO[str]) -> bool:
    """Return whether writing would wait for the reader: a full pipe, a terminal that was stopped with Ctrl-S."""
    try:
        ready = select.poll()
        ready.register(stream.fileno(), select.POLLOUT)
    except OSError:  # not a file
        return False
    return not ready.poll(0)


def _text(sink: Sink, model: TextIO | None, lines: bool) -> io.TextIOWrapper:
    encoding = "utf-8" if model is None else model.encoding
    buffer = io.BufferedWriter(sink)  # type: ignore[type-var]
    return io.TextIOWrapper(buffer, encoding=encoding, errors="tandem.ascii", line_buffering=lines)


def _ascii(error: UnicodeError) -> tuple[str | bytes, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    found = error.object[error.start : error.end]
    return "".join(_STAND_INS.get(one) or _escaped(one) for one in found), error.end


def _escaped(character: str) -> str:
    if "\u2500" <= character <= "\u28ff":  # lines, blocks, marks and spinner dots
        return "*"
    return character.encode("ascii", "backslashreplace").decode()


codecs.register_error("tandem.ascii", _ascii)
