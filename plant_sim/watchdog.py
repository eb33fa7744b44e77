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
        """`command` must have the plant's dimensions; what acts of it is clipped to [u_min, u_max]."""
        self.seq = command.seq
        self.arrived = arrived
        self._period = command.period
        self._patience = patience
        self._plant = plant
        self._plan = [command.u, *command.plan[1:]]
        self._first = self._within(command.u)

    def drive(self, t: float) -> Drive:
        """What acts at time t, `arrived` or later."""
        # A switching time that rounding put a hair too late still counts as reached.
        reached = t + 1e-9 * self._period + 4 * math.ulp(t)
        patience_ends = self.arrived + self._patience * self._period
        if patience_ends > reached:
            return Drive(self._first, "command", patience_ends)
        for entry in range(math.floor(self._patience), len(self._plan)):
            ends = self.arrived + (entry + 1) * self._period
            if ends > reached:
                return Drive(self._within(self._plan[entry]), "plan", ends)
        return Drive(self._within(self._plant.safe_input), "safe", math.inf)

    def _within(self, u: list[float] | np.ndarray) -> np.ndarray:
        # Entry by entry, as they are needed: most plans are never followed beyond their first.
        return np.minimum(np.maximum(u, self._plant.u_min), self._plant.u_max)
