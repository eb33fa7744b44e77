"""A controller's counters since its start, and its immediate messages for a person."""

from __future__ import annotations

import logging

from node_runtime.health import HealthPublisher
from node_runtime.rejected import RejectedMessages
from protocol import messages as m
from protocol import topics

log = logging.getLogger(__name__)

COUNTS = (
    "ticks",
    "late_ticks",
    "skipped_slots",
    "states_missing",
    "states_stale",
    "weights_adopted",
    "weights_refused",
    "weights_rolled_back",
    "references_taken",
    "checkpoints_written",
    "checkpoints_failed",
)


class Tally:
    """The counters and messages of one controller.

    Args:
        counts: the counters of `COUNTS`, which are updated here.
        health: receives the distrusted sensors.
        bad: counts refused messages.
    """

    def __init__(self, counts: dict[str, int], health: HealthPublisher, bad: RejectedMessages):
        self.counts, self._health, self._bad = counts, health, bad
        self._faults: dict[str, str] = {}

    @property
    def note(self) -> str:
        """The distrusted sensors, for a person; empty if there are none."""
        return "; ".join(self._faults.values())

    def add(self, tick: m.Tick, result: m.TickResult, overrun: bool) -> None:
        """Count one more tick; `overrun` means that its command came after the next slot's time."""
        counts = self.counts
        counts["ticks"] += 1
        counts["late_ticks"] += tick.late or overrun
        counts["skipped_slots"] += tick.skipped
        counts["states_missing"] += tick.state_verdict == "missing"
        counts["states_stale"] += tick.state_verdict == "stale"
        counts["weights_adopted"] += result.weights_outcome == "adopted"
        if result.weights_outcome == "refused":
            counts["weights_refused"] += 1
            self._bad.count(topics.HIDDEN_WEIGHTS.name, "refused", result.weights_verdict)
        if (verdict := result.reference_verdict).startswith("refused"):
            self._bad.count(topics.REFERENCE.name, "refused", f"{verdict} (of {result.reference_from})")
        counts["references_taken"] += verdict == "taken"
        if rolled_back := result.weights_rolled_back:
            counts["weights_rolled_back"] += 1
            log.warning("tick %d: hidden weights %s", tick.seq, rolled_back)
        if result.sensor_faults or self._faults:
            self._report_faults(tick, result.sensor_faults)

    def _report_faults(self, tick: m.Tick, faults: dict[str, str]) -> None:
        """Report changes of the distrusted sensors in health and in this process's log."""
        before = self._faults
        words = {name: m.words_of_fault(name, fault, tick.t) for name, fault in faults.items()}
        self._faults = {name: before.get(name, text) for name, text in words.items()}
        if self._faults.keys() == before.keys():
            return
        for name in faults.keys() - before.keys():
            log.warning("tick %d: %s", tick.seq, self._faults[name])
        for name in before.keys() - faults.keys():
            log.info("tick %d: sensor %s is trusted again", tick.seq, name)
        self._health.set("running", self.note)
