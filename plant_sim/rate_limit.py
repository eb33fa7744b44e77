"""The rate limit of the inputs, applied to every input that acts. No clock and no I/O."""

from __future__ import annotations

import numpy as np

from lbmpc.plants import Description
from lbmpc.plants.rows import together

ROUNDING = 1e-6
"""Tolerance as a share of a period and of a step, because differences of large times are not exact."""


class RateLimit:
    """Ensures that no two inputs within one period differ by more than rate x period.

    On a grid of whole periods this is |u_i - u_{i-1}| <= rate period. It also holds for partial periods and for a
    burst of commands, and therefore for the means over successive periods. An input is delayed until the input that
    limits it is a period old, so an early command waits. If U has rows besides its box, all inputs move together along
    the line to the requested input, which stays in U. Times are in seconds and must not decrease.
    """

    def __init__(self, plant: Description, period: float):
        """Start at the safe input, which the actuator has without commands."""
        rates = plant.input_rates
        self._plant = plant
        self._step, self._period = rates * period, period
        self._limited = bool(np.isfinite(rates).any())
        self._rounding = np.where(np.isfinite(rates), ROUNDING * self._step, 0.0)
        self._acts = plant.within(plant.safe_input)
        # End and value of each input that acted within the last period.
        self._before: list[tuple[float, np.ndarray]] = []

    def nearest(self, u: np.ndarray, t: float) -> np.ndarray:
        """Return the input nearest to u, (m,), in U, that may act from t on; u itself if it may."""
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
        """Record that u, (m,), acts from t on."""
        if self._limited and not np.array_equal(u, self._acts):
            self._before.append((t, self._acts))
            self._acts = u

    def next_step(self, t: float) -> float:
        """Return when the limit next allows more than at t."""
        return self._before[0][0] + self._period if self._before else t + self._period
