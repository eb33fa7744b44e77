"""How far an input may go from what acted before it: one rule for all that acts. No clock and no I/O."""

from __future__ import annotations

import numpy as np

from lbmpc.plants import Description
from lbmpc.plants.rows import together

ROUNDING = 1e-6
"""Share of a period, and of a step: differences of large times are not exact."""


class RateLimit:
    """No two inputs that act within one period differ by more than rate x period.

    On a grid of whole periods that is |u_i - u_{i-1}| <= rate period. It holds at broken times and through a burst of
    commands too, and so do the means over a period differ from one to the next. What may not act yet may act once
    what holds it back is a period old: a command that comes early waits. Where U has rows beside its box all inputs
    move together, on the straight way to what is asked for, which stays in U. Times in seconds, which must not fall.
    """

    def __init__(self, plant: Description, period: float):
        """Before anything acts, the actuator is where it is without anybody: at the safe input."""
        rates = plant.input_rates
        self._plant = plant
        self._step, self._period = rates * period, period
        self._limited = bool(np.isfinite(rates).any())
        self._rounding = np.where(np.isfinite(rates), ROUNDING * self._step, 0.0)
        self._acts = plant.within(plant.safe_input)
        # When each ended that acted within the last period, and what it was.
        self._before: list[tuple[float, np.ndarray]] = []

    def nearest(self, u: np.ndarray, t: float) -> np.ndarray:
        """The input nearest to u, (m,), which is in U, that may act from t on; u itself where it may."""
        if not self._limited:
            return u
        self._before = [one for one in self._before if one[0] > t - (1.0 - ROUNDING) * self._period]
        seen = np.array([self._acts, *(before for _ended, before in self._before)])
        low, high = seen.max(axis=0) - self._step, seen.min(axis=0) + self._step
        if self._plant.input_rows.names:
            reached = self._plant.within(together(u, self._acts, low, high))
        else:
            reached = np.minimum(np.maximum(u, low), high)
        return u if (np.abs(reached - u) <= self._rounding).all() else reached

    def acts(self, u: np.ndarray, t: float) -> None:
        """From t on u acts, (m,)."""
        if self._limited and not np.array_equal(u, self._acts):
            self._before.append((t, self._acts))
            self._acts = u

    def next_step(self, t: float) -> float:
        """When more may act than at t."""
        return self._before[0][0] + self._period if self._before else t + self._period
