"""What drives the plant's input: a fresh command, else the rest of its plan, else the plant's safe input."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from lbmpc.plants import Plant
from protocol.messages import Command, InputSource


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """What acts from some moment on."""

    u: np.ndarray
    """(m,), within the actuator's range."""
    source: InputSource
    until: float
    """When something else takes over if no command comes; infinite for the safe input."""


class Orders:
    """The last command and what follows from it as time goes by; immutable. Times in seconds.

    The command's input acts for `patience` periods from its arrival. Then the plan's entry of each elapsed
    period acts, and after the last one the plant's safe input, for ever.
    """

    def __init__(self, plant: Plant, command: Command, arrived: float, patience: float):
        """`command` must have the plant's dimensions; its entries are clipped to [u_min, u_max]."""
        self.seq = command.seq
        self.arrived = arrived
        self._period = command.period
        self._patience = patience
        self._plan = np.clip([command.u, *command.plan[1:]], plant.u_min, plant.u_max)
        self._safe = np.clip(plant.safe_input, plant.u_min, plant.u_max)

    def drive(self, t: float) -> Drive:
        """What acts at time t, `arrived` or later."""
        # A switching time that rounding put a hair too late still counts as reached.
        elapsed = (t - self.arrived) / self._period + 1e-9
        if elapsed < self._patience:
            return Drive(self._plan[0], "command", self._when(self._patience, t))
        entry = math.floor(elapsed)
        if entry < len(self._plan):
            return Drive(self._plan[entry], "plan", self._when(entry + 1, t))
        return Drive(self._safe, "safe", math.inf)

    def _when(self, periods: float, t: float) -> float:
        return max(self.arrived + periods * self._period, math.nextafter(t, math.inf))
