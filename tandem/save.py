"""Writes a run that never was in a file to one, in the recorder's format."""

from __future__ import annotations

from pathlib import Path

from lbmpc.plants import Plant
from protocol import topics
from run_log.reader import Run
from run_log.writer import LogWriter


def save(run: Run, path: Path, plant: Plant) -> None:
    """Write every message of `run` to the new file `path`, in the order of its times.

    Raises:
        LogError: there is a file of that name already, or it cannot be written.
    """
    messages = [
        (entry.log_time, topics.BY_NAME[name], entry.message)
        for name, entries in run.streams.items()
        for entry in entries
    ]
    messages.sort(key=lambda item: item[0])
    with LogWriter(path, run.config, plant) as writer:
        for log_time, topic, message in messages:
            writer.write_message(topic, message, log_time)
