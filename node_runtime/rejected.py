"""Rejected messages: counted by topic and reason, and logged once per kind."""

from __future__ import annotations

import logging
import threading

from node_runtime.printable import printable
from protocol.messages import counter_name

log = logging.getLogger(__name__)

# A hostile sender must not fill the memory with reasons, and the counters are part of every Health message.
MAX_KINDS = 200


class RejectedMessages:
    """Counts per (topic, reason). The first message of each kind is logged with its detail."""

    def __init__(self) -> None:
        self._counts: dict[str, int] = {}
        self._lock = threading.Lock()

    def count(self, topic: str, reason: str, detail: str = "") -> bool:
        """Count one message; return whether it is the first of its kind.

        `reason` is one of a few fixed texts. `detail` is only logged.
        """
        key = counter_name("bad", topic, reason)
        with self._lock:
            if key not in self._counts and len(self._counts) >= MAX_KINDS:
                key = "bad_other"
            seen = self._counts.get(key, 0)
            self._counts[key] = seen + 1
        if seen == 0:
            told = printable(detail[:300]) or "no detail"
            text = f"bad {topic}: {reason}"
            log.warning("%s (%s); ignored, further ones are only counted", text, told)
        return seen == 0

    def counters(self) -> dict[str, int]:
        """Return the counters by names such as "bad_plant_state_not_finite"."""
        with self._lock:
            return dict(self._counts)

    @property
    def total(self) -> int:
        """Number of rejected messages of every kind."""
        with self._lock:
            return sum(self._counts.values())
