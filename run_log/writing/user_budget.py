"""Limits on the logging of user topics, because the recorder and its disk serve the plant first."""

from __future__ import annotations

from protocol import topics
from run_log.views.views import MOST_USER_TOPICS

BYTES_PER_S = 1024 * 1024
"""Bytes per second for all these topics together: about the rate of Tandem's own messages at 1 kHz."""
MESSAGES_PER_S = 1000.0
"""Messages per second for all these topics together: the tick rate of a 1 kHz loop."""
BURST_S = 4.0
"""After a pause, messages of this many seconds may arrive at once."""


class UserBudget:
    """Decides for each message whether it is logged."""

    def __init__(self) -> None:
        self._topics: set[str] = set()
        self._bytes = BURST_S * BYTES_PER_S
        self._messages = BURST_S * MESSAGES_PER_S
        self._at: int | None = None

    def admit(self, name: str, size: int, time_ns: int) -> bool:
        """Whether a message of this size in bytes is logged; `time_ns` is its arrival."""
        seconds = 0.0 if self._at is None else max(0.0, (time_ns - self._at) * 1e-9)
        self._at = time_ns
        self._bytes = min(BURST_S * BYTES_PER_S, self._bytes + seconds * BYTES_PER_S)
        self._messages = min(BURST_S * MESSAGES_PER_S, self._messages + seconds * MESSAGES_PER_S)
        if size > min(self._bytes, topics.USER_MAX_BYTES) or self._messages < 1.0:
            return False
        if name not in self._topics and len(self._topics) >= MOST_USER_TOPICS:
            return False
        self._topics.add(name)
        self._bytes -= size
        self._messages -= 1.0
        return True
