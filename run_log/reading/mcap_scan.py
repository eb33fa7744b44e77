"""Read an MCAP file record by record, and distinguish complete, cut off and damaged files.

Every byte is covered by a checksum of the format: chunks and attachments have their own, the data section
and the summary have one each. A file that was cut short (power, kill -9) lacks the last two and ends in the
middle of a record; all records before that are intact.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import IO, TypeAlias

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Header, Message, Metadata, Schema
from mcap.stream_reader import CRCValidationError, breakup_chunk
from mcap.writer import MCAP0_MAGIC

from node_runtime.whole_file import open_regular
from run_log.errors import LogError

PREFIX = struct.Struct("<BQ")
FOOTER = struct.Struct("<BQQQI")
UNPACKED_TIMES, UNPACKED_ALWAYS = 64, 64 * 1024 * 1024
"""Limits on the unpacked size: a multiple of the file's size, or a number of bytes. Logs of Tandem unpack to two or
three times their size. A file that unpacks to much more is made to exhaust the memory."""
UNREADABLE = (
    McapError,
    CRCValidationError,
    struct.error,
    zstandard.ZstdError,
    UnicodeDecodeError,
    ValueError,
)
Record: TypeAlias = Header | Attachment | Metadata | Schema | Channel | Message


@dataclass
class Scan:
    """Iterate over it once; afterwards the attributes describe the file.

    With `keep_going`, damage is noted and reading continues after it if possible; without, it raises.
    """

    path: Path
    keep_going: bool = False
    cut_at: int | None = None
    """Byte at which a truncated file ends; None for a complete one."""
    damage: list[str] = field(default_factory=list)
    size: int = 0
    unpacked: int = 0
    """Bytes of the chunks so far, uncompressed."""

    def __iter__(self) -> Iterator[Record]:
        """Raises `LogError` if the file cannot be opened, is not an MCAP file, or is damaged."""
        try:
            with open_regular(self.path) as stream:
                self.size = stream.seek(0, 2)
                stream.seek(0)
                yield from self._records(stream)
        except OSError as error:
            raise LogError(f"{self.path}: cannot be read: {error.strerror}") from error

    def _records(self, stream: IO[bytes]) -> Iterator[Record]:
        magic = stream.read(len(MCAP0_MAGIC))
        if magic != MCAP0_MAGIC:
            what = "is empty" if not self.size else "is not an MCAP file: it does not begin as one"
            raise LogError(f"{self.path}: {what}; a log of Tandem is named like run.mcap")
        checksum, position = zlib.crc32(magic), len(magic)
        while position < self.size:
            prefix = stream.read(PREFIX.size)
            opcode, length = PREFIX.unpack(prefix) if len(prefix) == PREFIX.size else (0, self.size)
            if position + PREFIX.size + length > self.size:
                if self._ends_whole(stream):
                    self._damaged(
                        position, "a record's length is wrong, or the end of the data is not marked"
                    )
                else:
                    self.cut_at = position
                return
            body = stream.read(length)
            if opcode == Opcode.DATA_END:
                self._check_data_end(position, body, checksum)
                yield from self._summary(stream, position + PREFIX.size + length)
                return
            yield from self._parsed(position, opcode, body)
            checksum = zlib.crc32(body, zlib.crc32(prefix, checksum))
            position += PREFIX.size + length
        self.cut_at = position

    def _parsed(self, position: int, opcode: int, body: bytes) -> list[Record]:
        data = ReadDataStream(BytesIO(body))
        try:
            match opcode:
                case Opcode.HEADER:
                    return [Header.read(data)]
                case Opcode.SCHEMA:
                    return [Schema.read(data)]
                case Opcode.CHANNEL:
                    return [Channel.read(data)]
                case Opcode.MESSAGE:
                    return [Message.read(data, len(body))]
                case Opcode.METADATA:
                    return [Metadata.read(data)]
                case Opcode.ATTACHMENT:
                    expected = int.from_bytes(body[-4:], "little")
                    if expected not in (0, zlib.crc32(body[:-4])):
                        raise ValueError("its checksum is wrong")
                    return [Attachment.read(data)]
                case Opcode.CHUNK:
                    return self._chunk(Chunk.read(data))
                case _:  # indexes, and records of later versions of the format
                    return []
        except UNREADABLE as error:
            name = Opcode(opcode).name.lower()
            self._damaged(position, f"a record ({name}) has a wrong checksum or cannot be read: {error}")
            return []

    def _chunk(self, chunk: Chunk) -> list[Record]:
        size = chunk.uncompressed_size
        if chunk.compression not in ("", "zstd"):
            raise ValueError(f"its compression {chunk.compression!r} is not used in logs of Tandem")
        packed = chunk.compression == "zstd"
        if (zstandard.frame_content_size(chunk.data) if packed else len(chunk.data)) != size:
            raise ValueError("its size differs from the stated size")
        self.unpacked += size
        if self.unpacked > max(UNPACKED_TIMES * self.size, UNPACKED_ALWAYS):
            raise LogError(
                f"{self.path}: {self.size} bytes that unpack to more than {self.unpacked - 1}: not read, because no "
                f"log of Tandem unpacks to {UNPACKED_TIMES} times its size, and this one would fill the memory"
            )
        return [record for record in breakup_chunk(chunk, validate_crc=True) if isinstance(record, Record)]

    def _check_data_end(self, position: int, body: bytes, checksum: int) -> None:
        if len(body) != 4 or int.from_bytes(body, "little") not in (0, checksum):
            self._damaged(position, "the checksum over all data is wrong")

    def _summary(self, stream: IO[bytes], start: int) -> Iterator[Record]:
        """Read the schemas and channels again: a damaged chunk may have held their first occurrence."""
        rest = stream.read()
        summary, magic = rest[: -len(MCAP0_MAGIC)], rest[-len(MCAP0_MAGIC) :]
        footer = summary[-FOOTER.size :]
        whole, marked = (
            magic == MCAP0_MAGIC,
            footer.startswith(PREFIX.pack(Opcode.FOOTER, FOOTER.size - PREFIX.size)),
        )
        if not whole and not marked:
            self.cut_at = start
            return
        checksum = FOOTER.unpack(footer)[-1] if marked else -1
        if not whole or checksum not in (0, zlib.crc32(summary[:-4])):
            self._damaged(start, "the checksum over the index at its end is wrong")
            return
        position = 0
        while position + PREFIX.size < len(summary):
            opcode, length = PREFIX.unpack_from(summary, position)
            body = summary[position + PREFIX.size : position + PREFIX.size + length]
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                yield from self._parsed(start + position, opcode, body)
            position += PREFIX.size + length

    def _ends_whole(self, stream: IO[bytes]) -> bool:
        here = stream.tell()
        stream.seek(-len(MCAP0_MAGIC), 2)
        whole = stream.read() == MCAP0_MAGIC
        stream.seek(here)
        return whole

    def _damaged(self, position: int, what: str) -> None:
        text = f"at byte {position}: {what}"
        if not self.keep_going:
            raise LogError(
                f"{self.path}: damaged or edited {text}. "
                f"`tandem recover {self.path}` writes the intact messages to a new file."
            )
        self.damage.append(text)
