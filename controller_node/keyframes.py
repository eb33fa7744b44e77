"""Publishes keyframes: at the start and end of a run, at regular intervals, and when a recorder starts listening."""

from __future__ import annotations

from collections import deque

from controller_node.memory import Memory
from lbmpc.controller.state import ControllerState
from node_runtime.bus.zenoh_bus import Bus
from protocol import topics

AGAIN_AT = (0.0, 1.0)
"""Seconds after a recorder starts listening at which it gets a keyframe, so that everything it receives from then on
can be replayed. The second one serves a recorder that reconnects later than another reader."""
STATES_KEPT, MESSAGES_A_TICK = 16, 3
"""Number of stored states for ticks that were not sent yet, and minimum number of bulk messages per tick."""


class Keyframes:
    """Publishes one controller's keyframes on the bus.

    Args:
        bus: the plant's bus, open.
        memory: the controller's memory.
        every: ticks between two keyframes.
    """

    def __init__(self, bus: Bus, memory: Memory, every: int):
        self._bus, self._memory, self._every = bus, memory, every
        self._last = -1
        self._states: deque[tuple[int, ControllerState]] = deque(maxlen=STATES_KEPT)
        self._heard: int | None = None
        self._due: list[float] = []
        bus.when_heard(topics.KEYFRAME, self._add_listener)

    def remember(self, seq: int) -> None:
        """Store the state after tick `seq`, before the next tick begins."""
        self._states.append((seq, self._memory.state))

    def begin(self) -> None:
        """Send the keyframe before the first tick, which serves all present listeners."""
        self._heard = None
        self.send(-1)

    def send(self, seq: int) -> None:
        """Send the present memory as the keyframe after tick `seq`."""
        self._last = seq
        self._bus.publish(topics.KEYFRAME, self._memory.keyframe(seq))

    def send_due(self, seq: int) -> None:
        """Send a keyframe if it is due at this tick."""
        if (seq + 1) % self._every == 0:
            self.send(seq)

    def send_last(self, seq: int) -> None:
        """Send the last keyframe unless it was sent."""
        if self._last < seq:
            self.send(seq)

    def greet(self, seq: int, now: float) -> None:
        """Send keyframes to a new listener: after tick `seq`, and before each tick that it may still receive.

        Call it between two ticks; `now` is in seconds on the monotonic clock.
        """
        if self._heard is not None:
            ticks, self._heard = self._heard // MESSAGES_A_TICK + 2, None
            for before, state in list(self._states)[-ticks:]:
                self._bus.publish(topics.KEYFRAME, self._memory.keyframe(before, state))
            self._due = [now + after for after in AGAIN_AT]
        if self._due and now >= self._due[0]:
            del self._due[0]
            self.send(seq)

    def _add_listener(self, unsent: int) -> None:
        """Record a new listener, in a thread of the bus. It will receive the `unsent` messages of earlier ticks."""
        self._heard = unsent
