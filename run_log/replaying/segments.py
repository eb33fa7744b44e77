"""Ticks of a run that can be replayed: those after a keyframe, up to the next missing one."""

from __future__ import annotations

from dataclasses import dataclass, field

from run_log.errors import LogError
from run_log.reading.gaps import holes
from run_log.replaying.recorded import RecordedController
from run_log.run import Run

NAMED = 8
"""Number of tick numbers that a note lists before it says how many more there are."""


@dataclass
class Segments:
    """Segments as (keyframe, last tick) in `ranges`, and a note on every gap between them."""

    start: int
    """The keyframe at which the replay begins."""
    ranges: list[tuple[int, int]] = field(default_factory=list)
    lost: int = 0
    """Ticks that cannot be replayed, or not be compared completely."""
    notes: list[str] = field(default_factory=list)


def replayable(run: Run, recorded: RecordedController, from_tick: int | None) -> Segments:
    """Return the segments from the nearest keyframe before `from_tick`; None: from the first keyframe of the log.

    Raises:
        LogError: there is no keyframe before `from_tick`.
    """
    segments = _begin(run, recorded, from_tick)
    last, begin = recorded.last, segments.start
    # A missing tick ends a segment: the controller's memory is known again at the next keyframe.
    for gap, length in holes(recorded.ticks, begin + 1, last):
        if gap <= begin:
            continue
        if gap > begin + 1:
            segments.ranges.append((begin, gap - 1))
        later = [seq for seq in recorded.keyframes if gap <= seq < last and seq + 1 in recorded.ticks]
        begin = min(later, default=last)
        segments.lost += begin - gap + 1
        way = (
            f"replay continues at tick {begin + 1}, after the next keyframe"
            if later
            else "there is no later keyframe to continue from"
        )
        segments.notes.append(
            f"gap of {length} tick{'s' * (length > 1)} at tick {gap} of {recorded.run_id}: the recorder lost them; "
            f"{way}{run.unreadable}"
        )
    if begin < last:
        segments.ranges.append((begin, last))
    _note_uncompared(run, recorded, segments)
    return segments


def _begin(run: Run, recorded: RecordedController, from_tick: int | None) -> Segments:
    """Return where to begin, and a note on the ticks before it."""
    wanted = 0 if from_tick is None else from_tick
    before = [seq for seq in recorded.keyframes if seq < wanted]
    if before:
        return Segments(max(before))
    inside = [seq for seq in recorded.keyframes if seq < recorded.last]
    # Prefer keyframes with a next tick: a late recorder also receives keyframes of ticks that it missed.
    later = min((seq for seq in inside if seq + 1 in recorded.ticks), default=min(inside, default=None))
    missing = f"no keyframe before tick {wanted} of {recorded.run_id} is in the log"
    unknown = f"{missing}: the controller's memory at that tick is not known"
    if from_tick is not None:
        way = "" if later is None else f"; the first one is after tick {later}: use --from-tick {later + 1}"
        raise LogError(f"{run.path}: {unknown}{way}{run.unreadable}")
    segments = Segments(recorded.last if later is None else later)
    # Ticks before the first keyframe of a part are also in the previous part.
    if run.part == 1 or later is None:
        way = "none of it can be replayed" if later is None else f"replay begins at tick {later + 1}"
        segments.lost = sum(seq <= segments.start for seq in recorded.ticks)
        segments.notes.append(f"{unknown}; {way}{run.unreadable}")
    return segments


def _note_uncompared(run: Run, recorded: RecordedController, segments: Segments) -> None:
    """Note on ticks that are replayed although the log lacks some of their recorded messages."""
    every, end = recorded.config.controller.keyframe_every, recorded.last + recorded.complete
    replayed = [seq for begin, last in segments.ranges for seq in range(begin + 1, last + 1)]
    uncompared: set[int] = set()
    for name, expected, found in (
        ("command", replayed, recorded.commands),
        ("result", replayed, recorded.results),
        ("keyframe", [seq for seq in replayed if (seq + 1) % every == 0 and seq < end], recorded.keyframes),
    ):
        absent = [seq for seq in expected if seq not in found]
        uncompared.update(absent)
        if absent:
            more = f" and {len(absent) - NAMED} more" if len(absent) > NAMED else ""
            segments.notes.append(
                f"not compared because the recorder lost them: {name} of tick "
                f"{', '.join(map(str, absent[:NAMED]))}{more} of {recorded.run_id}{run.unreadable}"
            )
    segments.lost += len(uncompared)
