"""The log of a long run, in parts: each is a complete log that can be plotted and replayed alone.

The index of an MCAP file grows in memory until the file ends. Two parts overlap: both are written until the new one
contains a keyframe, where its replay begins, and `OVERLAP_S` longer, so that late messages of the old one arrive. Every
tick can be replayed from one of the parts.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from itertools import count
from pathlib import Path

from lbmpc.plants import Known, Plant
from node_runtime.config.sections import Config
from protocol import codec, topics
from run_log.errors import LogError, LogExistsError
from run_log.writing.writer import LogWriter

log = logging.getLogger(__name__)

OVERLAP_S = 1.0
"""Seconds after the new part's first keyframe."""
WITHOUT_KEYFRAME_S = 60.0
"""Seconds after which the old part no longer waits for a keyframe in the new one: there may be no controller."""
REPEATED = frozenset({*(topic.name for topic in topics.RUN_INFO.values()), topics.SETS.name})
"""Topics whose messages are sent once, and that every part needs."""
MOST_REPEATED = 8
"""Number of latest senders that are remembered for each of them."""


def part_path(first: Path, number: int) -> Path:
    """run.mcap, run.part2.mcap, run.part3.mcap."""
    return first if number == 1 else first.with_suffix(f".part{number}{first.suffix}")


def existing_parts(first: Path) -> list[Path]:
    """The parts on disk of the log whose first part is, or was, at `first`, in order."""
    start = f"{first.stem}.part"
    later = {}
    for path in first.parent.iterdir() if first.parent.is_dir() else ():
        number = path.name.removeprefix(start).removesuffix(first.suffix)
        if number.isdecimal() and path == part_path(first, int(number)):
            later[int(number)] = path
    return [*([first] if first.exists() else []), *(later[number] for number in sorted(later))]


class PartedLog:
    """One `LogWriter` after the other, by the settings in `config.log`. Data that cannot be written yet stay in memory.

    Args:
        config: the resolved configuration; `log.path` is the first part's.
        plant: the plant that `config` names.
        files: as of `LogWriter`.
        now: seconds on the monotonic clock.
        start_ns: Unix time of the beginning.

    Raises:
        LogExistsError: `log.path` exists already.
    """

    def __init__(
        self,
        config: Config,
        plant: Known | Plant,
        files: Mapping[str, str] | None = None,
        *,
        now: float,
        start_ns: int,
    ):
        self._config, self._plant, self._files = config, plant, files
        self._first = Path(config.log.path)
        self._numbers = count(2)
        self._writer = LogWriter(self._first, config, plant, files, start_ns=start_ns, patient=True)
        self._old: LogWriter | None = None
        """The old part, which is also written while both overlap."""
        self._paths = [self._first]
        self._began = now
        self._keyframe_at: float | None = None
        """Time of the new part's first keyframe, while both overlap."""
        self._repeated: dict[str, dict[str, bytes]] = {name: {} for name in REPEATED}
        """Messages with which the next part begins, by topic and run."""
        self._before: dict[str, int] = {}
        self._bad_before: dict[str, int] = {}
        self._lost_before: dict[str, int] = {}
        """Counters of the earlier parts when this one began."""
        self._last_bad_before: str | None = None
        self._torn: str | None = None
        """Reason why an earlier part is incomplete."""

    @property
    def path(self) -> Path:
        """The part that is written now."""
        return self._writer.sink.path

    @property
    def error(self) -> str | None:
        """Reason why data cannot be written at the moment; None if all can."""
        return self._writer.sink.error or (self._old.sink.error if self._old is not None else None)

    @property
    def counters(self) -> dict[str, int]:
        """Counters of all parts together, each message once."""
        writer = self._writer
        own = {**writer.counters, "write_errors": writer.sink.errors, "file_bytes": writer.sink.written}
        return _sum(self._before, own)

    @property
    def lost(self) -> dict[str, int]:
        """Number of lost messages, by topic."""
        return _sum(self._lost_before, self._writer.lost)

    @property
    def bad(self) -> dict[str, int]:
        """Number of payloads that are in the log without a view, by topic and reason."""
        return _sum(self._bad_before, self._writer.bad)

    @property
    def last_bad(self) -> str | None:
        return self._writer.last_bad or self._last_bad_before

    def write(self, name: str, payload: bytes, log_time: int, now: float) -> None:
        """Log a message of topic `name`, as `LogWriter.write`; `now` is on the monotonic clock, s."""
        if name in REPEATED:
            self._remember(name, payload)
        self._writer.write(name, payload, log_time)
        if self._old is not None:
            self._old.write(name, payload, log_time)
            if name == topics.KEYFRAME.name and self._keyframe_at is None:
                self._keyframe_at = now

    def flush(self, now: float, unix_ns: int) -> None:
        """Hand all data to the operating system; begin a part, or end the previous one, when it is due."""
        self._writer.flush()
        if self._old is not None:
            self._old.flush()
            seen = now - OVERLAP_S if self._keyframe_at is None else self._keyframe_at
            waited = self._keyframe_at is not None or now - self._began > WITHOUT_KEYFRAME_S
            # The old part ends only when later messages are safe in the new part.
            if waited and now - seen >= OVERLAP_S and self._writer.sink.error is None:
                self._end_old()
        elif 0.0 < self._config.log.split_minutes * 60.0 <= now - self._began:
            self._begin_part(now, unix_ns)

    def close(self) -> None:
        """End every open part. Raises `LogError` if a part is incomplete."""
        if self._old is not None:
            self._end_old()
        try:
            self._writer.close()
        except LogError as error:
            self._torn = str(error)
        if self._torn is not None:
            raise LogError(self._torn)

    def _remember(self, name: str, payload: bytes) -> None:
        head = codec.head_of(payload)
        if head is None:
            return
        known = self._repeated[name]
        known.pop(head.run_id, None)
        known[head.run_id] = payload
        if len(known) > MOST_REPEATED:
            del known[next(iter(known))]

    def _begin_part(self, now: float, unix_ns: int) -> None:
        self._began = now
        for number in self._numbers:
            path = part_path(self._first, number)
            try:
                writer = LogWriter(
                    *(path, self._config, self._plant, self._files),
                    start_ns=unix_ns,
                    patient=True,
                    part=number,
                )
            except LogExistsError as error:
                log.warning("%s", error)
                continue
            break
        self._before, self._bad_before, self._lost_before = self.counters, self.bad, self.lost
        self._last_bad_before = self.last_bad
        self._old, self._writer, self._keyframe_at = self._writer, writer, None
        self._paths.append(path)
        for name, messages in self._repeated.items():
            for payload in messages.values():
                writer.write(name, payload, unix_ns)

    def _end_old(self) -> None:
        assert self._old is not None
        old, self._old = self._old, None
        try:
            old.close(continued=self.path)
        except LogError as error:
            log.error("%s", error)
            self._torn = str(error)
        log.info("%s is complete; the log continues in %s", old.sink.path, self.path)
        while 0 < self._config.log.keep < len(self._paths):
            oldest = self._paths.pop(0)
            try:
                oldest.unlink(missing_ok=True)
            except OSError as error:
                log.error("%s: cannot be removed for log.keep: %s", oldest, error.strerror)


def _sum(a: Mapping[str, int], b: Mapping[str, int]) -> dict[str, int]:
    return {name: a.get(name, 0) + b.get(name, 0) for name in {**a, **b}}
