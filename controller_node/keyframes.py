"""When a controller says its whole memory: at its beginning and end, every so often, and to who begins to listen."""

from __future__ import annotations

from collections import deque

from controller_node.memory import Memory
from lbmpc.controller.state import ControllerState
from node_runtime.bus.zenoh_bus import Bus
from protocol import topics

AGAIN_AT = (0.0, 1.0)
"""Seconds after a recorder began to listen, or does again, at which it gets a keyframe: all that it hears from then on
can be replayed. The second one is for who needs a moment longer to be back than another reader."""
STATES_KEPT, MESSAGES_A_TICK = 16, 3
"""Of ticks that were not sent yet when it began; each has at least so many messages of the bulk lane."""


class Keyframes:
    """One controller's keyframes on the bus.

    Args:
        bus: the plant's, open.
        memory: what they are of.
        every: ticks from one to the next.
    """

    def __init__(self, bus: Bus, memory: Memory, every: int):
        self._bus, self._memory, self._every = bus, memory, every
        self._last = -1
        self._states: deque[tuple[int, ControllerState]] = deque(maxlen=STATES_KEPT)
        self._heard: int | None = None
        self._due: list[float] = []
        bus.when_heard(topics.KEYFRAME, self._hear_reader)

    def remember(self, seq: int) -> None:
        """Tick `seq` is over and the next one begins."""
        self._states.append((seq, self._memory.state))

    def begin(self) -> None:
        """Before the first tick. Who is heard by now needs no greeting."""
        self._heard = None
        self.send(-1)

    def send(self, seq: int) -> None:
        """The memory as it is, after tick `seq`."""
        self._last = seq
        self._bus.publish(topics.KEYFRAME, self._memory.keyframe(seq))

    def send_due(self, seq: int) -> None:
        """`send`, where it is this tick's turn."""
        if (seq + 1) % self._every == 0:
            self.send(seq)

    def send_last(self, seq: int) -> None:
        """`send`, where that has not been done."""
        if self._last < seq:
            self.send(seq)

    def greet(self, seq: int, now: float) -> None:
        """Where somebody began to listen: of after tick `seq`, and of before each tick that he may still hear.

        Between two ticks; `now` in seconds on the monotonic clock.
        """
        if self._heard is not None:
            ticks, self._heard = self._heard // MESSAGES_A_TICK + 2, None
            for before, state in list(self._states)[-ticks:]:
                self._bus.publish(topics.KEYFRAME, self._memory.keyframe(before, state))
            self._due = [now + after for after in AGAIN_AT]
        if self._due and now >= self._due[0]:
            del self._due[0]
            self.send(seq)

    def _hear_reader(self, unsent: int) -> None:
        """In a thread of the bus. Of the ticks before this moment a reader hears those that were not sent yet."""
        self._heard = unsent
