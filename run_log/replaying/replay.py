"""`tandem replay`: a fresh controller, the recorded ticks, and all that comes out compared byte for byte."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from controller_node.certified_sets import CertifiedSets
from controller_node.core import ControllerCore
from lbmpc.sets.certificate import CertificateError
from node_runtime.config.sections import Config, from_json, override
from node_runtime.config.strict import ConfigError
from node_runtime.health import versions
from node_runtime.realtime.scheduling import one_blas_thread
from protocol import codec, topics
from protocol import messages as m
from protocol.topics import Topic
from run_log.errors import LogError
from run_log.reading.gaps import stretches
from run_log.reading.reader import Entry, Run
from run_log.replaying.difference import Difference, first_byte, first_difference

NAMED = 8
"""Tick numbers that a message lists before it says how many more there are."""
Progress = Callable[[int, int], None]


class ReplayResult(msgspec.Struct, frozen=True, kw_only=True):
    """What a replay found. Equal means: every command, backup, result, output weight and keyframe, every byte."""

    ticks: int
    """Replayed and compared."""
    equal: bool
    first_difference: Difference | None
    differing_ticks: int
    largest_difference: float | None
    """Largest |recorded - replayed| among the inputs of all plans, in units of u; null where sizes differ."""
    keyframes: int
    """Compared."""
    first_tick: int
    """Where the replay began: the tick after a keyframe."""
    run_ids: list[str]
    lost_ticks: int
    """Ticks that could not be replayed, or not compared whole: the log lacks them, or the memory they began with."""
    notes: list[str]
    """What a person should know: other versions, changed settings, an incomplete last tick."""


@dataclass
class _Recorded:
    """One controller run as the log has it, by tick."""

    run_id: str
    config: Config
    ticks: dict[int, Entry[m.Tick]]
    commands: dict[int, Entry[m.Command]]
    backups: dict[int, Entry[m.Backup]]
    results: dict[int, Entry[m.TickResult]]
    weights: dict[int, Entry[m.OutputWeights]]
    keyframes: dict[int, Entry[m.Keyframe]]
    sets: CertifiedSets | None
    complete: bool
    """The log holds the run to its end; if not, its last tick may lack some of its messages."""

    @property
    def last(self) -> int:
        ends = [max(found, default=-1) for found in (self.ticks, self.commands, self.results)]
        return max(ends) if self.complete else min(ends)


def replay(
    run: Run,
    from_tick: int | None = None,
    overrides: Sequence[str] = (),
    progress: Progress | None = None,
) -> ReplayResult:
    """Replay every controller run of a log from the log alone.

    Args:
        run: a log, as read.
        from_tick: begin at the nearest keyframe before this tick; None: at the first tick.
        overrides: `section.key=value`, to see what a change would have done.
        progress: called with (ticks done, ticks in all).

    Raises:
        LogError: there is nothing to begin with, messages are recorded twice or do not fit the plant; the log's
            configuration admits no controller.
        ConfigError: an override cannot be applied.
    """
    recorded = [_collect(run, run_id) for run_id in run.controllers]
    if not recorded:
        raise LogError(
            f"{run.path}: holds no tick of a controller; there is nothing to replay{_unreadable(run)}"
        )
    if from_tick is not None:
        inside = [r for r in recorded if 0 <= from_tick <= r.last]
        if not inside:
            ranges = ", ".join(f"{min(r.ticks)} to {r.last}" for r in recorded)
            raise LogError(f"{run.path}: there is no tick {from_tick}; the log has {ranges}")
        recorded = inside
    comparison = _Comparison()
    starts = [_start(run, r, from_tick, comparison) for r in recorded]
    total = sum(r.last - start for r, start in zip(recorded, starts, strict=True))
    for r, start in zip(recorded, starts, strict=True):
        config = override(r.config, list(overrides)) if overrides else r.config
        with one_blas_thread():
            _replay_one(run, r, config, start, bool(overrides), comparison, progress, total)
    if not comparison.ticks:
        raise LogError(f"{run.path}: no tick can be replayed: {'; '.join(comparison.gaps)}{_unreadable(run)}")
    return ReplayResult(
        ticks=comparison.ticks,
        equal=comparison.first is None,
        first_difference=comparison.first,
        differing_ticks=len(comparison.differing),
        largest_difference=comparison.largest,
        keyframes=comparison.keyframes,
        first_tick=starts[0] + 1,
        run_ids=[r.run_id for r in recorded],
        lost_ticks=comparison.lost,
        notes=_notes(run, recorded, overrides) + comparison.gaps,
    )


class _Comparison:
    """Counts what was compared, and keeps the first difference."""

    def __init__(self) -> None:
        self.ticks = 0
        self.keyframes = 0
        self.first: Difference | None = None
        self.differing: set[tuple[str, int]] = set()
        self.largest: float | None = 0.0
        self.lost = 0
        self.gaps: list[str] = []

    def compare(self, entry: Entry[Any], replayed: m.Message | None, name: str) -> None:
        payload = b"" if replayed is None else codec.encode(replayed)
        if payload == entry.payload:
            return
        recorded = entry.message
        self.differing.add((recorded.run_id, recorded.seq))
        if self.first is None:
            found = first_difference(recorded, replayed, name)
            field, left, right = found or first_byte(entry.payload, payload, name)
            self.first = Difference(
                run_id=recorded.run_id, tick=recorded.seq, field=field, recorded=left, replayed=right
            )

    def measure(self, recorded: m.Command, replayed: m.Command) -> None:
        a, b = recorded.plan, replayed.plan
        if self.largest is None or [len(row) for row in a] != [len(row) for row in b]:
            self.largest = None
            return
        self.largest = max(self.largest, float(np.max(np.abs(np.array(a) - np.array(b)), initial=0.0)))


def _replay_one(
    run: Run,
    recorded: _Recorded,
    config: Config,
    start: int,
    changed: bool,
    comparison: _Comparison,
    progress: Progress | None,
    total: int,
) -> None:
    sets = _sets_for(run, recorded, config)
    try:
        core = ControllerCore(config, recorded.run_id, sets)
    except ConfigError as error:
        raise (
            error if changed else LogError(f"{run.path}: its configuration admits no controller: {error}")
        ) from error
    for begin, end in _parts(run, recorded, start, comparison):
        _begin(run, recorded, core, begin, changed, comparison)
        for seq in range(begin + 1, end + 1):
            _replay_tick(run, recorded, core, seq, comparison)
            if progress is not None:
                progress(comparison.ticks, total)


def _replay_tick(
    run: Run, recorded: _Recorded, core: ControllerCore, seq: int, comparison: _Comparison
) -> None:
    tick = recorded.ticks[seq].message
    if tick.state is not None:
        try:
            codec.check_dimensions(topics.PLANT_STATE, tick.state, core.plant.d, core.plant.m)
        except codec.BadMessage as error:
            raise LogError(f"{run.path}: tick {seq} does not fit the plant: {error}") from error
    outputs = core.step(tick)
    if seq in recorded.commands:
        comparison.compare(recorded.commands[seq], outputs.command, "command")
        comparison.measure(recorded.commands[seq].message, outputs.command)
    if seq in recorded.backups:
        comparison.compare(recorded.backups[seq], core.backup(outputs.command), "backup")
    if seq in recorded.results:
        comparison.compare(recorded.results[seq], outputs.result, "result")
    if seq in recorded.weights and outputs.output_weights is not None:
        comparison.compare(recorded.weights[seq], outputs.output_weights, "output_weights")
    if seq in recorded.keyframes:
        comparison.compare(recorded.keyframes[seq], core.memory.keyframe(seq), "keyframe")
        comparison.keyframes += 1
    comparison.ticks += 1


def _begin(
    run: Run, recorded: _Recorded, core: ControllerCore, start: int, changed: bool, comparison: _Comparison
) -> None:
    """Put the core where the log's keyframe says that the controller was."""
    entry = recorded.keyframes[start]
    if start == -1 and not entry.message.resumed:
        # The memory before the first tick follows from the configuration and the seed: that is compared too.
        comparison.compare(entry, core.memory.keyframe(-1), "keyframe")
        comparison.keyframes += 1
    try:
        core.memory.restore(entry.message)
    except ValueError as error:
        if start == -1 and not entry.message.resumed:
            return  # a difference, and already noted; a changed configuration begins with its own memory
        hint = (
            "; from the first tick on, the changed configuration begins with a memory of its own"
            if changed
            else ""
        )
        raise LogError(f"{run.path}: {error}{hint}") from error


def _sets_for(run: Run, recorded: _Recorded, config: Config) -> CertifiedSets | None:
    """The certified sets that were in force; None: there were none, or others are asked for now."""
    then = recorded.config.controller
    if config.controller.tightening != "invariant" or config.controller.sets != then.sets:
        return None
    if then.tightening == "invariant" and recorded.sets is None:
        raise LogError(
            f"{run.path}: the certified sets of {recorded.run_id} are not in the log: its recorder began after the "
            f"controller{_unreadable(run)}"
        )
    return recorded.sets


def _recorded_sets(run: Run, run_id: str) -> CertifiedSets | None:
    for entry in run.entries(topics.SETS):
        if entry.message.run_id == run_id:
            try:
                return CertifiedSets.from_bytes(entry.message.content)
            except CertificateError as error:
                raise LogError(f"{run.path}: the certified sets of {run_id}: {error}") from error
    return None


def _collect(run: Run, run_id: str) -> _Recorded:
    def by_tick(topic: Topic) -> dict[int, Entry[Any]]:
        found: dict[int, Entry[Any]] = {}
        for entry in run.entries(topic):
            if entry.message.run_id != run_id:
                continue
            before = found.setdefault(entry.message.seq, entry)
            if before.payload != entry.payload:
                raise LogError(
                    f"{run.path}: {topic.name} of tick {entry.message.seq} is there twice, and different; "
                    f"another process spoke as {run_id}, or the log was edited"
                )
        return found

    infos = [info for info in run.run_infos if info.run_id == run_id]
    try:
        config = from_json(infos[0].config) if infos else run.config
    except ConfigError as error:
        raise LogError(f"{run.path}: {error}; the log was made by another version of Tandem") from error
    said = [health.status for health in run.health if health.run_id == run_id]
    return _Recorded(
        run_id=run_id,
        config=config,
        ticks=by_tick(topics.TICK),
        commands=by_tick(topics.COMMAND),
        backups=by_tick(topics.BACKUP),
        results=by_tick(topics.RESULT),
        weights=by_tick(topics.OUTPUT_WEIGHTS),
        keyframes=by_tick(topics.KEYFRAME),
        sets=_recorded_sets(run, run_id),
        # A simulation has no health; a live run that ended says so.
        complete=not run.ends_within and (not said or "stopping" in said),
    )


def _start(run: Run, recorded: _Recorded, from_tick: int | None, comparison: _Comparison) -> int:
    """The keyframe to begin at. From the start: the first one that the log has, and a word on what comes before it."""
    wanted = 0 if from_tick is None else from_tick
    before = [seq for seq in recorded.keyframes if seq < wanted]
    if before:
        return max(before)
    later = min((seq for seq in recorded.keyframes if seq < recorded.last), default=None)
    missing = f"no keyframe before tick {wanted} of {recorded.run_id} is in the log"
    unknown = f"{missing}: the controller's memory is not known there"
    if from_tick is not None:
        way = "" if later is None else f"; the first one is after tick {later}: use --from-tick {later + 1}"
        raise LogError(f"{run.path}: {unknown}{way}{_unreadable(run)}")
    start = recorded.last if later is None else later
    # What comes before the first keyframe of a part is in the part before this one as well.
    if run.part == 1 or later is None:
        way = "none of it can be replayed" if later is None else f"replay begins at tick {later + 1}"
        comparison.lost += sum(seq <= start for seq in recorded.ticks)
        comparison.gaps.append(f"{unknown}; {way}{_unreadable(run)}")
    return start


def _parts(run: Run, recorded: _Recorded, start: int, comparison: _Comparison) -> list[tuple[int, int]]:
    """(keyframe, last tick) of every part that can be replayed, and a word on what lies between them.

    A tick that is missing ends a part: what the controller knew after it is known again at the next keyframe.
    """
    every, last = recorded.config.controller.keyframe_every, recorded.last
    missing = [seq for seq in range(start + 1, last + 1) if seq not in recorded.ticks]
    parts, begin = [], start
    while (gap := next((seq for seq in missing if seq > begin), None)) is not None:
        if gap > begin + 1:
            parts.append((begin, gap - 1))
        length = next(count for first, count in stretches(missing) if first <= gap < first + count)
        again = min(
            (seq for seq in recorded.keyframes if gap < seq < last and seq + 1 in recorded.ticks),
            default=None,
        )
        text = f"gap of {length} tick{'s' * (length > 1)} at tick {gap} of {recorded.run_id}: the recorder lost them"
        comparison.gaps.append(
            f"{text}; there is no keyframe behind it to go on from{_unreadable(run)}"
            if again is None
            else f"{text}; replay goes on at tick {again + 1}, behind the next keyframe{_unreadable(run)}"
        )
        comparison.lost += (last if again is None else again) - gap + 1
        begin = last if again is None else again
    if begin < last:
        parts.append((begin, last))
    end = last + 1 if recorded.complete else last
    replayed = [seq for first, until in parts for seq in range(first + 1, until + 1)]
    needed = [seq for seq in replayed if (seq + 1) % every == 0 and seq < end]
    uncompared: set[int] = set()
    for name, expected, found in (
        ("command", replayed, recorded.commands),
        ("result", replayed, recorded.results),
        ("keyframe", needed, recorded.keyframes),
    ):
        absent = [seq for seq in expected if seq not in found]
        uncompared.update(absent)
        if absent:
            more = f" and {len(absent) - NAMED} more" if len(absent) > NAMED else ""
            comparison.gaps.append(
                f"not compared, the recorder lost them: {name} of tick {', '.join(map(str, absent[:NAMED]))}{more} "
                f"of {recorded.run_id}{_unreadable(run)}"
            )
    comparison.lost += len(uncompared)
    return parts


def _unreadable(run: Run) -> str:
    if not run.bad:
        return ""
    return f". In the log but not readable: {', '.join(f'{n} {what}' for what, n in run.bad.items())}"


def _notes(run: Run, recorded: list[_Recorded], overrides: Sequence[str]) -> list[str]:
    notes = [f"changed: {' '.join(overrides)}"] if overrides else []
    if run.note:
        notes.append(run.note)
    here = versions()
    for info in run.run_infos:
        if info.run_id in {r.run_id for r in recorded}:
            other = [
                f"{name} {then} (here {here[name]})"
                for name, then in info.versions.items()
                if name in here and here[name] != then
            ]
            if other:
                notes.append(
                    f"recorded with {', '.join(other)}: equal to about 1e-7 at best, not to the byte"
                )
    strangers = {tick.run_id for tick in run.ticks} - set(run.controllers)
    if strangers:
        notes.append(
            "not replayed, since it never said what it is, or its results are not of its ticks: "
            f"{', '.join(sorted(strangers))}"
        )
    for r in recorded:
        if -1 in r.keyframes and (before := r.keyframes[-1].message.resumed):
            notes.append(f"{r.run_id}: goes on from the memory of {before}, out of a checkpoint")
        if not r.complete:
            notes.append(
                f"{r.run_id}: the log does not hold the run to its end; replayed up to tick {r.last}"
            )
    return notes
