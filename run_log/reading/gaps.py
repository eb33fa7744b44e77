"""Gaps of a log: ticks of a controller whose messages never reached the recorder."""

from __future__ import annotations

from collections.abc import Iterable

from protocol import topics
from run_log.run import Run

EACH_TICK = (topics.TICK, topics.COMMAND, topics.RESULT)
"""Every tick has one of each, so a missing number is a lost message."""


def holes(there: Iterable[int], first: int, last: int) -> list[tuple[int, int]]:
    """Yield (first, number) of every missing stretch of first..last.

    The work depends on how many numbers are present and not on their range, because a log may contain any number.
    """
    inside = sorted({number for number in there if first <= number <= last})
    between = zip([first - 1, *inside], [*inside, last + 1], strict=True)
    return [(a + 1, b - a - 1) for a, b in between if b > a + 1]


def lost_ticks(run: Run) -> list[tuple[str, int, int]]:
    """Yield (run id, first tick, number) of every gap between a controller's first and last tick in the log."""
    found = []
    for run_id in run.controllers:
        logged = [
            {e.message.seq for e in run.entries(topic) if e.message.run_id == run_id} for topic in EACH_TICK
        ]
        if not all(logged):
            logged = [set.union(*logged), set()]
        # If a log begins or ends within a run, an incomplete tick there is no loss.
        first = (max if run.part > 1 else min)(min(seqs) for seqs in logged if seqs)
        last = (min if run.ends_within else max)(max(seqs) for seqs in logged if seqs)
        found += [(run_id, at, count) for at, count in holes(set.intersection(*logged), first, last)]
    return found
