"""The pace of training with noisy labels: trainings become rarer while they bring no gain.

After a training without gain the next one waits for twice as many new samples as this one did, up to a share of the
buffer. It starts at once if the newest samples are predicted worse than the samples held out before. Losses and gains
are in units of the labels' variance: a network that predicts h exactly has a loss of 1.
"""

from __future__ import annotations

from dataclasses import dataclass

GAIN = 0.05
"""Smallest gain that counts. A smaller one would fit the noise."""
RISE = 1.0
"""Increase of the loss on the newest samples that indicates a change of the plant."""
RENEWED = 0.25
"""Share of new samples in the buffer after which the next training is always due."""


@dataclass(frozen=True)
class Worth:
    """The benefit of a training."""

    gain: float
    """Decrease of the loss on samples that were not trained on."""
    pays: bool
    """Whether the training gave new hidden layers."""

    def __str__(self) -> str:
        if self.pays:
            return f"training gains {self.gain:.0%} of the labels' variance"
        return f"training has nothing to gain ({max(self.gain, 0.0):.1%} of the labels' variance)"


class Pace:
    """Counts the new samples since the start of the last training.

    Args:
        shortest: samples between two trainings with gain, and between two evaluations of the loss.
        capacity: capacity of the buffer.
    """

    def __init__(self, shortest: int, capacity: int):
        self._shortest, self._longest = shortest, max(shortest, round(RENEWED * capacity))
        self._loss = 0.0
        self.hurry()

    def hurry(self) -> None:
        """Make the next training due as soon as after one with gain."""
        self._wait = self._looked_at = self._shortest

    def trained(self, fresh: int, loss: float, worth: Worth) -> None:
        """Record a training that began with `fresh` new samples and the held-out loss `loss`."""
        self.hurry()
        if not worth.pays:
            # If trainings were farther apart than necessary, that distance is doubled.
            self._wait = min(2 * max(fresh, self._shortest), self._longest)
            self._loss, self._looked_at = loss, 0

    def over(self, fresh: int) -> bool:
        """Return whether `fresh` new samples are enough for a training."""
        return fresh >= self._wait

    def must_look(self, fresh: int) -> bool:
        """Return whether `fresh` new samples are enough to evaluate the loss on the newest of them again."""
        if fresh < self._looked_at + self._shortest:
            return False
        self._looked_at = fresh
        return True

    def look(self, loss: float) -> None:
        """Make a training due if the loss on the newest samples has risen."""
        if loss > self._loss + RISE:
            self.hurry()
