"""Reads a log message by message, all parts as one. The memory use does not grow with the log."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from mcap.records import Attachment, Channel, Header, Message, Metadata

from node_runtime.config.sections import Config
from protocol import codec, topics
from run_log.errors import LogError
from run_log.file_format import CONFIG, RAW, check_header
from run_log.raw_message import NotRaw, payload_of
from run_log.reading.mcap_scan import Scan
from run_log.reading.reader import interpret, take_metadata
from run_log.run import Entry, Run
from run_log.writing.parts import REPEATED, existing_parts

RUN_INFO = frozenset(topic.name for topic in topics.RUN_INFO.values())


class Logged(NamedTuple):
    """One encoded message of a log."""

    name: str
    """The key of its topic below `tandem/<plant>/`."""
    log_time: int
    """ns, as `Entry.log_time`."""
    payload: bytes


@dataclass
class Source:
    """A log in one file or in several parts. Iterate over it once; afterwards the fields say what was read.

    Args:
        path: the log, or its first remaining part; the later parts are found from it.

    Raises:
        LogError: the file cannot be opened, is not a log of Tandem, or contains no usable configuration or plant.
    """

    path: Path
    parts: list[Path] = field(default_factory=list)
    """The files that were read, in order."""
    strangers: dict[str, int] = field(default_factory=dict)
    """Number of messages on unknown keys, by key."""
    damage: list[str] = field(default_factory=list)
    """Records with a wrong checksum, which are missing in the export."""
    notes: list[str] = field(default_factory=list)
    """Notes for a person about the files, such as where one was cut."""

    def __post_init__(self) -> None:
        self.run = _opening(self.path)
        """Configuration, plant, attachments and number of the first part, without messages."""
        self._seen: set[tuple[str, int]] = set()
        """Topic and checksum of messages that are repeated at the begin of each part."""
        self._newest: dict[tuple[str, str], int] = {}
        """Newest log time, by topic and run. Two parts overlap, and no newer message is repeated."""

    def __iter__(self) -> Iterator[Logged]:
        """Yield all messages in the order of the log. Raises `LogError` if a part cannot be opened."""
        path: Path | None = self.path
        while path is not None:
            self.parts.append(path)
            part = Run(path, self.run.config)
            before = dict(self._newest)
            for one in self._messages(part):
                head = codec.head_of(one.payload)
                key = (one.name, "" if head is None else head.run_id)
                if one.log_time <= before.get(key, one.log_time - 1):
                    continue
                self._newest[key] = max(one.log_time, self._newest.get(key, one.log_time))
                yield one
            path = self._next(part)

    def _messages(self, part: Run) -> Iterator[Logged]:
        scan, names = Scan(part.path, keep_going=True), dict[int, str]()
        encodings: dict[int, str] = {}
        nameless = 0
        for record in scan:
            match record:
                case Header():
                    check_header(part.path, record)
                case Metadata():
                    take_metadata(part, record)
                case Channel():
                    names[record.id] = record.topic
                    encodings[record.id] = record.message_encoding
                case Message() if record.channel_id not in names:
                    nameless += 1
                case Message() if names[record.channel_id].startswith(RAW):
                    name = names[record.channel_id].removeprefix(RAW)
                    try:
                        payload = payload_of(encodings[record.channel_id], record.data)
                    except NotRaw as error:
                        self.damage.append(f"{part.path}: {name}: {error}")
                        continue
                    one = Logged(name, record.log_time, payload)
                    if self._is_new(one):
                        yield one
        self.damage += [f"{part.path}: damaged {what}" for what in scan.damage]
        if nameless:
            self.damage.append(
                f"{part.path}: {nameless} messages belong to channels whose names are in a damaged part; "
                f"`tandem recover {part.path}` finds them in the index"
            )
        if scan.cut_at is not None:
            part.truncated = True
            self.notes.append(
                f"{part.path} was cut short at byte {scan.cut_at} of {scan.size}; all messages before that are exported"
            )

    def _is_new(self, one: Logged) -> bool:
        if one.name not in topics.BY_NAME and not topics.is_user(one.name):
            self.strangers[one.name] = self.strangers.get(one.name, 0) + 1
            return False
        if one.name in REPEATED:
            key = (one.name, zlib.crc32(one.payload))
            if len(self.parts) > 1 and key in self._seen:
                return False
            self._seen.add(key)
        return True

    def _next(self, part: Run) -> Path | None:
        """Return the next part, which the last record of this one names."""
        if part.continued is None:
            later = existing_parts(self.run.path)
            if part.truncated and later and later[-1] not in self.parts:
                self.notes.append(
                    f"{part.path} does not say whether it continues; {later[-1].name} is not exported"
                )
            return None
        # A log names a file in its own folder only.
        path = part.path.with_name(Path(part.continued).name or "?")
        if path in self.parts or not path.exists():
            self.notes.append(f"{part.path} continues in {part.continued}, which is not in the same folder")
            return None
        return path


def _opening(path: Path) -> Run:
    """Read the records before the first message. If the configuration is lost, that of the first process is used."""
    run = Run(path, Config())
    header, names, encodings = False, dict[int, str](), dict[int, str]()
    for record in Scan(path, keep_going=True):
        match record:
            case Header():
                header = True
                check_header(path, record)
            case Attachment():
                run.attachments[record.name] = record.data
            case Metadata():
                take_metadata(run, record)
            case Channel():
                names[record.id] = record.topic
                encodings[record.id] = record.message_encoding
            case Message() if CONFIG in run.attachments:
                break
            case Message():
                name = names.get(record.channel_id, "").removeprefix(RAW)
                if name in RUN_INFO:
                    try:
                        payload = payload_of(encodings[record.channel_id], record.data)
                        info = codec.decode(topics.BY_NAME[name], payload)
                    except (NotRaw, codec.BadMessage):
                        continue
                    run.streams[name] = [Entry(record.log_time, payload, info)]
                    break
    if not header:
        raise LogError(f"{path}: contains no message; there is nothing to export")
    interpret(run)
    run.streams.clear()
    return run
