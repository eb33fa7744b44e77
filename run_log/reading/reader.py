"""Reads the log of a run: decodes every message, and keeps its exact bytes."""

from __future__ import annotations

import re
from pathlib import Path

from mcap.records import Attachment, Channel, Header, Message, Metadata

from node_runtime.config.loading import from_json
from node_runtime.config.sections import Config
from node_runtime.config.strict import ConfigError
from protocol import codec, topics
from run_log import raw_message
from run_log.errors import LogError
from run_log.file_format import CONFIG, CONTINUED, IDENTITY, PLANT, RAW, RECOVERED, check_header
from run_log.plant_record import PlantRecordError, decode
from run_log.reading.mcap_scan import Scan
from run_log.run import Entry, Run


def read_run(path: str | Path) -> Run:
    """Read a whole log.

    A file that was cut short (kill -9, power) is read up to the cut, and `truncated` is set. Invalid messages in the
    log are counted in `bad`.

    Raises:
        LogError: unreadable, not MCAP, MCAP of something else, damaged or edited, no usable configuration or plant.
    """
    path = Path(path)
    scan = Scan(path)
    run = Run(path, Config())
    names: dict[int, tuple[str, str]] = {}
    """Topic, and encoding of the messages, by channel."""
    header: Header | None = None
    for record in scan:
        match record:
            case Header():
                header = record
                check_header(path, header)
            case Attachment():
                run.attachments[record.name] = record.data
            case Metadata():
                take_metadata(run, record)
            case Channel() if record.topic.startswith(RAW):
                names[record.id] = record.topic.removeprefix(RAW), record.message_encoding
            case Message() if record.channel_id in names:
                _take(run, *names[record.channel_id], record)
    if header is None:
        raise LogError(f"{path}: contains no message; there is nothing to recover")
    if scan.cut_at is not None:
        run.truncated = True
        run.note = (
            f"{path} was cut short at byte {scan.cut_at} of {scan.size}; all messages before that are read. "
            f"`tandem recover {path}` makes a complete file of it."
        )
    elif run.continued is not None:
        run.note = f"{path} is part {run.part} of its log, which continues in {run.continued}."
    interpret(run)
    return run


def interpret(run: Run) -> None:
    """Take the configuration and the plant from the attachments and messages read so far.

    Raises:
        LogError: there is no usable configuration, or the plant's record cannot be used.
    """
    run.config = _config(run.path, run)
    if PLANT in run.attachments:
        try:
            run.plant, run.files = decode(run.attachments[PLANT])
        except PlantRecordError as error:
            raise LogError(f"{run.path}: {PLANT}: {error}") from error


def take_metadata(run: Run, record: Metadata) -> None:
    """Copy the facts of one metadata record into `run`."""
    if record.name == RECOVERED:
        run.recovered = True
    elif record.name == CONTINUED:
        run.continued = record.metadata.get("in")
    elif record.name == IDENTITY and re.fullmatch("[0-9]{1,9}", part := record.metadata.get("part", "")):
        run.part = int(part)


def _take(run: Run, name: str, encoding: str, record: Message) -> None:
    try:
        payload = raw_message.payload_of(encoding, record.data)
    except raw_message.NotRaw:
        _count_bad(run, f"{name}: not wrapped")
        return
    if topics.is_user(name):
        run.user.setdefault(name, []).append((record.log_time, payload))
        return
    topic = topics.BY_NAME.get(name)
    if topic is None:
        run.strangers[name] = run.strangers.get(name, 0) + 1
        return
    try:
        message = codec.decode(topic, payload)
    except codec.BadMessage as error:
        _count_bad(run, f"{error.topic}: {error.reason}")
        return
    run.streams.setdefault(name, []).append(Entry(record.log_time, payload, message))


def _count_bad(run: Run, key: str) -> None:
    run.bad[key] = run.bad.get(key, 0) + 1


def _config(path: Path, run: Run) -> Config:
    """Return the attached configuration; if the file was cut before it, that of any process."""
    attached = run.attachments.get(CONFIG)
    texts = (
        [info.config for info in run.run_infos] if attached is None else [attached.decode(errors="replace")]
    )
    if not texts:
        raise LogError(f"{path}: contains no configuration, so its messages cannot be interpreted")
    try:
        return from_json(texts[0])
    except ConfigError as error:
        raise LogError(f"{path}: {error}; another version of Tandem wrote the log") from error
