"""A person's messages in lock-step: references and manual inputs.

Each message has a new number, so that none counts as a repetition.
"""

from __future__ import annotations

from collections.abc import Iterator

import msgspec
import numpy as np

from plant_sim.hand import Hand
from protocol import messages as m
from tandem.operating.hand_session import lease_of

COMMANDER = "commander-simulated"


class Person:
    """Sends each message at the right time.

    Args:
        period: of the loop, seconds.
        set_points: the reference from the begin of each episode; None: the configured one.
    """

    def __init__(self, period: float, set_points: m.Reference | None):
        self._period = period
        self._set_points = self._asked = set_points
        self._references = self._intentions = 0
        self.by_hand: m.Override | None = None
        """The message while the input acts manually."""

    def start_again(self) -> None:
        """Begin another episode."""
        self._asked = self._set_points or self._asked

    def ask(self, reference: m.Reference) -> None:
        """Give a reference that holds from the next period."""
        self._asked = reference

    def reference(self) -> m.Reference | None:
        """Return the new message since the last call; None if there is none."""
        if self._asked is None:
            return None
        said = msgspec.structs.replace(self._asked, run_id=f"{COMMANDER}-{self._references}", seq=0)
        self._asked, self._references = None, self._references + 1
        return said

    def manual(self, u: np.ndarray) -> m.Override:
        """Begin manual control with u, (m,), plant units."""
        lease = lease_of(self._period)
        self.by_hand = m.Override(run_id=self._name(), seq=0, mode="manual", u=u.tolist(), lease=lease)
        return self.by_hand

    def auto(self) -> m.Override:
        """End manual control."""
        self.by_hand = None
        return m.Override(run_id=self._name(), seq=0, mode="auto")

    def _name(self) -> str:
        self._intentions += 1
        return f"{COMMANDER}-hand-{self._intentions}"

    def renewals(self, hand: Hand, t: float) -> Iterator[tuple[m.Override, float]]:
        """Yield the repetitions of a manual input for the period from t, with their sending times; none after its end.

        The plant of `hand` must process each one before the next is requested.
        """
        if self.by_hand is None:
            return
        if not hand.acts:
            self.by_hand = None
            return
        while hand.until <= t + self._period:
            self.by_hand = said = msgspec.structs.replace(self.by_hand, seq=self.by_hand.seq + 1)
            yield said, hand.until - said.lease / 2.0
