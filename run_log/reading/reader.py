"""Reads the log of a run: every message decoded, its exact bytes kept."""

from __future__ import annotations

import json
import zlib
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, TypeVar, cast

from mcap.records import Attachment, Channel, Header, Message, Metadata

from node_runtime.config.sections import Config, from_json
from node_runtime.config.strict import ConfigError
from protocol import codec, topics
from protocol import messages as m
from protocol.topics import Topic
from run_log.errors import LogError
from run_log.reading.mcap_scan import Scan
from run_log.writing.writer import CONTINUED, FORMAT, IDENTITY, PROFILE

M = TypeVar("M", bound=m.Message)
RAW = "raw/"


@dataclass(frozen=True)
class Entry(Generic[M]):
    """One message as it was logged."""

    log_time: int
    """ns; Unix time of arrival for a live run, virtual time for a simulated one."""
    payload: bytes
    message: M


@dataclass
class Run:
    """All that a log says. The lists are in the order of the log; `entries` has the bytes as well."""

    path: Path
    config: Config
    attachments: dict[str, bytes] = field(default_factory=dict)
    streams: dict[str, list[Entry[Any]]] = field(default_factory=dict)
    """By topic name."""
    bad: dict[str, int] = field(default_factory=dict)
    """Logged payloads that are no valid messages, by topic and reason."""
    strangers: dict[str, int] = field(default_factory=dict)
    """Messages on keys that are no topic of ours, by key."""
    truncated: bool = False
    recovered: bool = False
    part: int = 1
    """Which one of its run's logs this is (`run_log.writing.parts`)."""
    continued: str | None = None
    """Name of the next one; None: this is the last, or was cut short."""
    note: str = ""
    """What a person should know about the file, e.g. where it was cut."""

    def entries(self, topic: Topic) -> list[Entry[Any]]:
        return self.streams.get(topic.name, [])

    def _messages(self, *of: Topic) -> list[Any]:
        entries = [entry for topic in of for entry in self.entries(topic)]
        if len(of) > 1:
            entries.sort(key=lambda entry: entry.log_time)
        return [entry.message for entry in entries]

    @property
    def plant_states(self) -> list[m.PlantState]:
        return self._messages(topics.PLANT_STATE)

    @property
    def commands(self) -> list[m.Command]:
        return self._messages(topics.COMMAND)

    @property
    def ticks(self) -> list[m.Tick]:
        return self._messages(topics.TICK)

    @property
    def results(self) -> list[m.TickResult]:
        return self._messages(topics.RESULT)

    @property
    def timings(self) -> list[m.TickTiming]:
        return self._messages(topics.TIMING)

    @property
    def samples(self) -> list[m.Sample]:
        return [sample for batch in self._messages(topics.SAMPLES) for sample in batch.samples]

    @property
    def output_weights(self) -> list[m.OutputWeights]:
        return self._messages(topics.OUTPUT_WEIGHTS)

    @property
    def hidden_weights(self) -> list[m.HiddenWeights]:
        return self._messages(topics.HIDDEN_WEIGHTS)

    @property
    def keyframes(self) -> list[m.Keyframe]:
        return self._messages(topics.KEYFRAME)

    @property
    def health(self) -> list[m.Health]:
        return self._messages(*topics.HEALTH.values())

    @property
    def run_infos(self) -> list[m.RunInfo]:
        """One for each process incarnation, the first that it sent."""
        first: dict[str, m.RunInfo] = {}
        for info in self._messages(*topics.RUN_INFO.values()):
            first.setdefault(info.run_id, info)
        return list(first.values())

    @property
    def controllers(self) -> list[str]:
        """Runs with ticks, in order, without strangers.

        A stranger said nothing of itself (no info, health or keyframe), or has no tick that one of its own results is
        of, by the checksum in the result. Where that is so of all, nobody is one.
        """
        spoke = {x.run_id for x in (*self.run_infos, *self.health, *self.keyframes)}
        sums: dict[tuple[str, int], set[int]] = {}
        for entry in self.entries(topics.TICK):
            sums.setdefault((entry.message.run_id, entry.message.seq), set()).add(zlib.crc32(entry.payload))
        answered = {r.run_id for r in self.results if r.tick_crc32 in sums.get((r.run_id, r.seq), ())}
        ticked = list(dict.fromkeys(run_id for run_id, _seq in sums))
        known = [run_id for run_id in ticked if run_id in spoke]
        return [run_id for run_id in known if run_id in answered] or known or ticked

    @property
    def ends_within(self) -> bool:
        """The log ends while its run goes on: the last tick may lack some of its messages."""
        return self.truncated or self.recovered or self.continued is not None

    @property
    def versions(self) -> dict[str, str]:
        """What the recorder had installed."""
        return cast(dict[str, str], json.loads(self.attachments.get("versions.json", b"{}")))


def gather(config: Config, messages: Iterable[tuple[Topic, m.Message, int]], path: str | Path = "") -> Run:
    """A `Run` of messages that never were in a file: (topic, message, log_time in ns)."""
    run = Run(Path(path), config)
    for topic, message, log_time in messages:
        run.streams.setdefault(topic.name, []).append(Entry(log_time, codec.encode(message), message))
    return run


def read_run(path: str | Path) -> Run:
    """Read a whole log.

    A file that was cut short (kill -9, power) is read up to the cut, and `truncated` is set. What is in the
    log but is no valid message is counted in `bad`.

    Raises:
        LogError: unreadable, not MCAP, MCAP of something else, damaged or edited, no usable configuration.
    """
    path = Path(path)
    scan = Scan(path)
    run = Run(path, Config())
    names: dict[int, str] = {}
    header: Header | None = None
    for record in scan:
        match record:
            case Header():
                header = record
                check_ours(path, header)
            case Attachment():
                run.attachments[record.name] = record.data
            case Metadata():
                _take_metadata(run, record)
            case Channel():
                names[record.id] = record.topic
            case Message():
                name = names.get(record.channel_id, "")
                if name.startswith(RAW):
                    _take(run, name.removeprefix(RAW), record)
            case _:
                pass
    if header is None:
        raise LogError(f"{path}: ends before anything was written to it; there is nothing to recover")
    if scan.cut_at is not None:
        run.truncated = True
        run.note = (
            f"{path} was cut short at byte {scan.cut_at} of {scan.size}; all before that is read. "
            f"`tandem recover {path}` makes a whole file of it."
        )
    elif run.continued is not None:
        run.note = f"{path} is part {run.part} of its log, which goes on in {run.continued}."
    run.config = _config(path, run)
    return run


def check_ours(path: Path, header: Header) -> None:
    """Raise `LogError` when the file is MCAP, but not a log of ours that this version understands."""
    if header.profile != PROFILE:
        whose = f"profile {header.profile!r}" if header.profile else "no profile"
        raise LogError(
            f"{path}: is an MCAP file with {whose}, written by {header.library!r}; not a log of Tandem"
        )
    expected = f"tandem log {FORMAT};"
    if not header.library.startswith(expected):
        raise LogError(f"{path}: was written as {header.library!r}; this Tandem reads {expected!r}")


def _take_metadata(run: Run, record: Metadata) -> None:
    if record.name == "recovered":
        run.recovered = True
    elif record.name == CONTINUED:
        run.continued = record.metadata.get("in")
    elif record.name == IDENTITY and (part := record.metadata.get("part", "")).isdecimal():
        run.part = int(part)


def _take(run: Run, name: str, record: Message) -> None:
    topic = topics.BY_NAME.get(name)
    if topic is None:
        run.strangers[name] = run.strangers.get(name, 0) + 1
        return
    try:
        message = codec.decode(topic, record.data)
    except codec.BadMessage as error:
        key = f"{error.topic}: {error.reason}"
        run.bad[key] = run.bad.get(key, 0) + 1
        return
    run.streams.setdefault(name, []).append(Entry(record.log_time, record.data, message))


def _config(path: Path, run: Run) -> Config:
    """The attached one; where the file was cut before it, that of any process."""
    texts = (
        [run.attachments["config.json"].decode(errors="replace")] if "config.json" in run.attachments else []
    )
    texts += [info.config for info in run.run_infos]
    if not texts:
        raise LogError(f"{path}: holds no configuration, so nothing in it can be interpreted")
    try:
        return from_json(texts[0])
    except ConfigError as error:
        raise LogError(f"{path}: {error}; the log was made by another version of Tandem") from error
