"""Presence of the plant, from its states alone: it appears, falls silent, returns, or is restarted. Pure."""

from __future__ import annotations

# As for Health, which comes twice a second.
SILENT_S, SILENT_PERIODS = 2.0, 3.0


class Presence:
    """Presence of one plant; times in seconds on any monotonic clock. Each event is reported once."""

    def __init__(self, period: float):
        self._limit = max(SILENT_S, SILENT_PERIODS * period)
        self._run_id = ""
        self._at: float | None = None
        self._missed = False

    @property
    def known(self) -> bool:
        """Whether it ever appeared."""
        return self._at is not None

    def silent(self, now: float) -> bool:
        """Whether no state arrived for a while, or ever."""
        return self._at is None or now - self._at > self._limit

    def came(self, run_id: str, now: float) -> str:
        """Take a state that arrived; return the event, if any."""
        missed, away = self._missed, "" if self._at is None else f" after {now - self._at:.1f} s"
        again = self.known and run_id != self._run_id
        self._run_id, self._at, self._missed = run_id, now, False
        if again:
            return f"the plant was restarted{away} as {run_id}: a new episode"
        return f"the plant is back{away}" if missed else ""

    def miss(self, now: float) -> str:
        """Return the event if a plant has fallen silent."""
        if self._at is None or self._missed or not self.silent(now):
            return ""
        self._missed = True
        return f"the plant is silent: no state for {now - self._at:.1f} s"
