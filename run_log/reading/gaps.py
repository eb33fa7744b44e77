"""What a log lacks: ticks that a controller made and whose messages never reached the recorder."""

from __future__ import annotations

from collections.abc import Iterable

from protocol import topics
from run_log.run import Run

EACH_TICK = (topics.TICK, topics.COMMAND, topics.RESULT)
"""Every tick has one of each, so a number that is missing is a message that was lost."""


def stretches(numbers: Iterable[int]) -> list[tuple[int, int]]:
    """Rising numbers as (first, how many) of each stretch without a hole."""
    found: list[tuple[int, int]] = []
    for number in numbers:
        if found and number == sum(found[-1]):
            found[-1] = (found[-1][0], found[-1][1] + 1)
        else:
            found.append((number, 1))
    return found


def lost_ticks(run: Run) -> list[tuple[str, int, int]]:
    """(run id, first tick, how many) of every gap between a controller's first and last tick in the log."""
    found = []
    for run_id in run.controllers:
        logged = [
            {e.message.seq for e in run.entries(topic) if e.message.run_id == run_id} for topic in EACH_TICK
        ]
        if not all(logged):
            logged = [set.union(*logged), set()]
        # Where a log begins or ends within a run, it is no loss that a tick has some of its messages only.
        first = (max if run.part > 1 else min)(min(seqs) for seqs in logged if seqs)
        last = (min if run.ends_within else max)(max(seqs) for seqs in logged if seqs)
        missing = sorted(set(range(first, last + 1)) - set.intersection(*logged))
        found += [(run_id, first, count) for first, count in stretches(missing)]
    return found
