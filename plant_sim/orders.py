"""The plant's input in order of precedence: a fresh command, the backup policy, the plan, the plant's safe input."""

from __future__ import annotations

import math
from collections.abc import Callable
from copy import copy
from dataclasses import dataclass

import numpy as np

from lbmpc.plants import Description
from protocol.messages import Backup, Command, InputSource

Measure = Callable[[], np.ndarray | None]
"""Returns the present x, (d,), with NaN for states without a number; None if it cannot be measured. It is called only
if an input depends on the state."""


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """An input and its time of validity."""

    u: np.ndarray
    """(m,), in U."""
    source: InputSource
    until: float
    """When another input takes over without a new command; infinite if none does."""


class Standby:
    """A backup policy with the start of its command; immutable. Times are in seconds."""

    def __init__(self, backup: Backup, arrived: float):
        """`backup` must have the plant's dimensions."""
        self._arrived = arrived
        self._period = backup.period
        self._inputs = backup.inputs
        self._gain = np.array(backup.gain)

    def drive(self, t: float, measure: Measure) -> tuple[np.ndarray, float] | None:
        """Return the policy's input at time t, and when it ends.

        The result is None before the first entry, after the last one, for an unknown state, and if the result is not
        finite.
        """
        entry = _elapsed(self._arrived, t, self._period)
        if not 1 <= entry <= len(self._inputs) or (x := measure()) is None:
            return None
        with np.errstate(over="ignore", invalid="ignore"):
            u = self._inputs[entry - 1] + self._gain @ x
        return (u, self._arrived + (entry + 1) * self._period) if np.isfinite(u).all() else None


class Orders:
    """The last command and the inputs that follow it over time; immutable. Times are in seconds.

    The command's input acts for `patience` periods from its arrival. After that, in each period, the backup policy acts
    while it has an entry, then the plan while it has an entry, then the plant's safe input.
    """

    def __init__(self, plant: Description, command: Command, arrived: float, patience: float):
        """`command` must have the plant's dimensions. Its inputs are clipped to U."""
        self.run_id, self.seq = command.run_id, command.seq
        self.arrived = arrived
        self._period = command.period
        self._patience_ends = arrived + patience * command.period
        self._plant = plant
        self._plan = [command.u, *command.plan[1:]]
        self._first = plant.within(command.u)

    def without_plan(self) -> Orders:
        """Return the same command, followed by the safe input."""
        alone = copy(self)
        alone._plan = self._plan[:1]
        return alone

    def drive(self, t: float, measure: Measure, standby: Standby | None = None) -> Drive:
        """Return the input at time t, which is `arrived` or later."""
        if self._patience_ends > _reached(t, self._period):
            return Drive(self._first, "command", self._patience_ends)
        if standby is not None and (backup := standby.drive(t, measure)) is not None:
            return Drive(self._plant.within(backup[0]), "plan", backup[1])
        entry = _elapsed(self.arrived, t, self._period)
        ends = self.arrived + (entry + 1) * self._period
        if entry < len(self._plan):
            # Entries are clipped when they are needed, because most plans are followed for one entry only.
            return Drive(self._plant.within(self._plan[entry]), "plan", ends)
        return safe_drive(self._plant, measure, ends)


def safe_drive(plant: Description, measure: Measure, ends: float) -> Drive:
    """Return the safe input. If it depends on the state, it is valid until `ends`; unknown states give no feedback."""
    if plant.safe_gain is None:
        return Drive(plant.within(plant.safe_input), "safe", math.inf)
    x = measure()
    u = plant.safe_input if x is None or not np.isfinite(x).all() else plant.safe_input_at(x)
    return Drive(plant.within(u), "safe", ends)


def _reached(t: float, period: float) -> float:
    """Return t plus a small tolerance, so that a switching time that is late by rounding counts as reached."""
    return t + 1e-9 * period + 4 * math.ulp(t)


def _elapsed(since: float, t: float, period: float) -> int:
    """Return the whole periods from `since` to t, so that the next one ends later than t."""
    entry = max(0, math.floor((t - since) / period))
    while since + (entry + 1) * period <= _reached(t, period):
        entry += 1
    return entry
