"""Writes a run that is only in memory, such as a simulation, into a log like that of a live run."""

from __future__ import annotations

from pathlib import Path

from protocol import topics
from run_log.file_format import VIRTUAL_CLOCK
from run_log.run import Run, plant_of
from run_log.writing.writer import LogWriter


def save(run: Run, path: str | Path) -> None:
    """Write all messages of `run` to a new log, in the order of their times.

    Raises:
        LogExistsError: `path` exists already.
        LogError: the file cannot be written, or not to its end.
    """
    entries = [(entry, topic) for topic in topics.ALL for entry in run.entries(topic)]
    entries.sort(key=lambda pair: pair[0].log_time)
    start = entries[0][0].log_time if entries else 0
    with LogWriter(path, run.config, plant_of(run), run.files, start_ns=start, clock=VIRTUAL_CLOCK) as writer:
        for entry, topic in entries:
            writer.write(topic.name, entry.payload, entry.log_time)
