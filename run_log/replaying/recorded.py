"""The content of a log for each controller: its messages by tick, its configuration and its certified sets."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from controller_node.certified_sets import CertifiedSets
from lbmpc.sets.certificate import CertificateError
from node_runtime.config.loading import from_json
from node_runtime.config.sections import Config
from node_runtime.config.strict import ConfigError
from protocol import messages as m
from protocol import topics
from protocol.topics import Topic
from run_log.errors import LogError
from run_log.run import Entry, Run


@dataclass(frozen=True)
class RecordedController:
    """One run of a controller. The keys of the dictionaries are ticks."""

    run_id: str
    config: Config
    ticks: dict[int, Entry[m.Tick]]
    commands: dict[int, Entry[m.Command]]
    backups: dict[int, Entry[m.Backup]]
    results: dict[int, Entry[m.TickResult]]
    weights: dict[int, Entry[m.OutputWeights]]
    keyframes: dict[int, Entry[m.Keyframe]]
    sets: CertifiedSets | None
    known: str
    """sha256 of the controller's numbers of the plant; empty if the log does not have it."""
    architecture: str
    """The network's file, name in it and hash of its text; empty for an architecture of Tandem."""
    complete: bool
    """Whether the log contains the end of the run; if not, its last tick may lack some messages."""

    @property
    def last(self) -> int:
        """The last tick. A log that ends early may contain only some of its messages."""
        ends = [max(found, default=-1) for found in (self.ticks, self.commands, self.results)]
        return max(ends) if self.complete else min(ends)


def recorded_controllers(run: Run) -> list[RecordedController]:
    """Return the controllers of a log in the order of the log, without strangers.

    Raises:
        LogError: two different messages of one tick, a configuration or certified sets that cannot be read.
    """
    return [_recorded(run, run_id) for run_id in run.controllers]


def _recorded(run: Run, run_id: str) -> RecordedController:
    infos = [info for info in run.run_infos if info.run_id == run_id]
    try:
        config = from_json(infos[0].config) if infos else run.config
    except ConfigError as error:
        raise LogError(f"{run.path}: {error}; another version of Tandem wrote the log") from error
    said = [health.status for health in run.health if health.run_id == run_id]
    return RecordedController(
        run_id=run_id,
        config=config,
        ticks=_by_tick(run, run_id, topics.TICK),
        commands=_by_tick(run, run_id, topics.COMMAND),
        backups=_by_tick(run, run_id, topics.BACKUP),
        results=_by_tick(run, run_id, topics.RESULT),
        weights=_by_tick(run, run_id, topics.OUTPUT_WEIGHTS),
        keyframes=_by_tick(run, run_id, topics.KEYFRAME),
        sets=_sets(run, run_id),
        known=infos[0].versions.get("known plant", "") if infos else "",
        architecture=infos[0].versions.get("architecture", "") if infos else "",
        # A simulation has no health; the health of a finished live run is "stopping".
        complete=not run.ends_within and (not said or "stopping" in said),
    )


def _by_tick(run: Run, run_id: str, topic: Topic) -> dict[int, Entry[Any]]:
    found: dict[int, Entry[Any]] = {}
    for entry in run.entries(topic):
        seq = entry.message.seq
        if entry.message.run_id == run_id and found.setdefault(seq, entry).payload != entry.payload:
            raise LogError(
                f"{run.path}: {topic.name} of tick {seq} is in the log twice with different content; "
                f"another process used the name {run_id}, or the log was edited"
            )
    return found


def _sets(run: Run, run_id: str) -> CertifiedSets | None:
    for entry in run.entries(topics.SETS):
        if entry.message.run_id == run_id:
            try:
                return CertifiedSets.from_bytes(entry.message.content)
            except CertificateError as error:
                raise LogError(f"{run.path}: the certified sets of {run_id}: {error}") from error
    return None
