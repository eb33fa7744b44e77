"""When to train again where labels are noisy: later and later where there is nothing to gain.

After a training that gained nothing the next one waits for twice as many new samples as this one did, until a share of
the buffer is new. It begins at once when the newest samples are predicted worse than what was held out then. Losses and
gains are shares of the labels' variance: a network that predicts h has a loss of 1.
"""

from __future__ import annotations

from dataclasses import dataclass

GAIN = 0.05
"""What is less is nothing: its fit would be one of the noise."""
RISE = 1.0
"""By how much the loss on the newest samples is higher where something has changed."""
RENEWED = 0.25
"""Share of the buffer that is new, at most, before the next training."""


@dataclass(frozen=True)
class Worth:
    """What a training was good for."""

    gain: float
    """By how much the loss fell on samples that were not trained on."""
    pays: bool
    """Whether hidden layers came of it."""

    def __str__(self) -> str:
        if self.pays:
            return f"training gains {self.gain:.0%} of the labels' variance"
        return f"training has nothing to gain ({max(self.gain, 0.0):.1%} of the labels' variance)"


class Pace:
    """Counts samples that are new since the last training began.

    Args:
        shortest: samples between two trainings where there is something to gain, and between two looks at the loss.
        capacity: of the buffer.
    """

    def __init__(self, shortest: int, capacity: int):
        self._shortest, self._longest = shortest, max(shortest, round(RENEWED * capacity))
        self._loss = 0.0
        self.hurry()

    def hurry(self) -> None:
        """The next training is due as soon as after one that gained something."""
        self._wait = self._looked_at = self._shortest

    def trained(self, fresh: int, loss: float, worth: Worth) -> None:
        """After a training that began with so many new samples, and from this loss on what it held out."""
        self.hurry()
        if not worth.pays:
            # Where trainings are farther apart than they need be, it is that distance which doubles.
            self._wait = min(2 * max(fresh, self._shortest), self._longest)
            self._loss, self._looked_at = loss, 0

    def over(self, fresh: int) -> bool:
        """Whether so many new samples are enough."""
        return fresh >= self._wait

    def must_look(self, fresh: int) -> bool:
        """Whether so many new samples are enough to look at the loss on the newest of them again."""
        if fresh < self._looked_at + self._shortest:
            return False
        self._looked_at = fresh
        return True

    def look(self, loss: float) -> None:
        """Hurry where the loss on the newest samples has risen."""
        if loss > self._loss + RISE:
            self.hurry()
