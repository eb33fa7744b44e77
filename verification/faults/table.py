"""Write the suite's outcomes as a Markdown table into the document between its two marks."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence

import msgspec

from benchmarks.document_block import Marks
from verification.faults import holds
from verification.faults.catalogue import Fault
from verification.faults.facts import Facts, Replayed
from verification.faults.suite import Outcome

MARKS = Marks.of("faults", "make faults")
COLUMNS = (
    "fault",
    "runs",
    "held",
    "samples outside X or U, without the fault",
    "deepest, % of half-width",
    "late, by the machine itself",
    "back, s",
    "control after that, s",
    "J, without the fault",
    "tick p99, without the fault, ms",
    "samples not merged",
    "unreadable, s",
    "replay",
)


class Pair(msgspec.Struct, frozen=True):
    """A run and the one without the fault, with the same seed."""

    outcome: Outcome
    calm: Facts


def rows(pairs: dict[str, list[Pair]], faults: Sequence[Fault]) -> Iterator[list[str]]:
    """Return the cells of each fault that was run."""
    for fault in faults:
        found = pairs.get(fault.name, [])
        if not found:
            continue
        held = sum(not pair.outcome.not_held for pair in found)
        ran = [(pair.outcome.facts, pair.calm) for pair in found if pair.outcome.facts is not None]
        yield [fault.name, str(len(found)), str(held), *_figures(fault, ran)]


def _figures(fault: Fault, ran: list[tuple[Facts, Facts]]) -> list[str]:
    if not ran:
        return [""] * (len(COLUMNS) - 3)
    run, calm = [facts for facts, _ in ran], [facts for _, facts in ran]
    late = sum(facts.late for facts in run)
    unmerged = [f.samples_made - f.samples_held for f in run if f.samples_held is not None]
    return [
        f"{sum(f.violations for f in run)}, {sum(f.violations for f in calm)}",
        f"{100.0 * max(f.deepest for f in run):.1f}, {100.0 * max(f.deepest for f in calm):.1f}",
        f"{late}, {sum(f.late_by_machine for f in run)}" if late else "0",
        _most([f.ready_after for f in run]) if holds.control_back in fault.holds else "",
        _most([f.control_after for f in run]) if holds.control_back in fault.holds else "",
        f"{_median([f.J for f in run]):.3g}, {_median([f.J for f in calm]):.3g}",
        f"{_median([f.tick_p99_ms or 0.0 for f in run]):.1f}, {_median([f.tick_p99_ms or 0.0 for f in calm]):.1f}",
        str(max(map(abs, unmerged), default=0)),
        _most([f.readable_gap for f in run]),
        _replays([f.replay for f in run]),
    ]


def _most(values: list[float | None]) -> str:
    """Format median and largest; say so if a value never came."""
    known = [value for value in values if value is not None]
    if not known:
        return ""
    return f"{_median(known):.2f}, at most {max(known):.2f}"


def _median(values: list[float]) -> float:
    return sorted(values)[len(values) // 2]


def _replays(replays: list[Replayed]) -> str:
    kinds = Counter(replay.verdict for replay in replays)
    return ", ".join(f"{count} {kind}" for kind, count in kinds.most_common())


def reasons(pairs: dict[str, list[Pair]]) -> Iterator[str]:
    """Return the table rows of the failed checks, by fault."""
    for name, found in pairs.items():
        for pair in found:
            for why in pair.outcome.not_held:
                yield f"| {name} | {pair.outcome.index} | {pair.outcome.at:.2f} | {why.splitlines()[0][:200]} |"


def markdown(pairs: dict[str, list[Pair]], faults: Sequence[Fault], head: list[str]) -> str:
    """All of it."""
    cells = list(rows(pairs, faults))
    rule = ["---", *["---:"] * (len(COLUMNS) - 2), "---"]
    lines = [*head, "", *(f"| {' | '.join(row)} |" for row in (list(COLUMNS), rule, *cells))]
    failed = list(reasons(pairs))
    if not failed:
        return "\n".join([*lines, "", "All checks passed."])
    lines += [
        "",
        "Checks that failed:",
        "",
        "| fault | run | fault at, s | check |",
        "| --- | ---: | ---: | --- |",
    ]
    lines += failed
    return "\n".join(lines)
