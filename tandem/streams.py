"""Standard output and standard error of a command: whoever reads them, or has ceased to, nothing here fails by it.

A pipe may be closed, a disk full, a terminal gone or of another encoding. What cannot be written is dropped, what
cannot be encoded is written as ASCII, and the command goes on to its end; only its exit code tells of it.
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

# One cell for one cell, so that what stands in columns stays there.
_STAND_INS = dict(zip("─━├┤┼●◀▶→–…▁▂▃▄▅▆▇█╸╺•’", "-=||+o<>>-._.:-=+*#==*'", strict=True))


class Sink(io.RawIOBase):
    """Writes to a file descriptor until that fails; what comes later is dropped."""

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
        """All of `data`, or nothing any more."""
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
        """Why it failed; "" where it has not, or where only the reader has gone, who may."""
        if self.failed is None or self._terminal or self.failed.errno == errno.EPIPE:
            return ""
        return os.strerror(self.failed.errno or 0)


class Output:
    """What became of standard output."""

    def __init__(self, sink: Sink | None = None):
        self._sink = sink

    def exit_code(self, code: int) -> int:
        """The command's own, or 1 where all went well but what it had to say could not be written."""
        sys.stdout.flush()
        lost = self._sink.lost if self._sink is not None else ""
        if lost:
            sys.stderr.write(f"tandem: standard output cannot be written: {lost}\n")
        return code or (1 if lost else 0)


@contextmanager
def never_failing() -> Iterator[Output]:
    """Meanwhile `sys.stdout` and `sys.stderr` are streams that never fail. One that is closed is the null device."""
    own = sys.stdout, sys.stderr
    if own != (sys.__stdout__, sys.__stderr__):  # somebody has put others there, to read what is written
        yield Output()
        return
    while (
        number := os.open(os.devnull, os.O_RDWR)
    ) <= 2:  # no file of ours may get the number of a closed one
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
    """Whether writing would wait for the reader: a full pipe, a terminal that was stopped with Ctrl-S."""
    try:
        ready = select.poll()
        ready.register(stream.fileno(), select.POLLOUT)
    except OSError:  # it is no file
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
    if "\u2500" <= character <= "\u28ff":  # lines, blocks, marks, and the dots that turn while one waits
        return "*"
    return character.encode("ascii", "backslashreplace").decode()


codecs.register_error("tandem.ascii", _ascii)
