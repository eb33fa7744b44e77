"""What drives the plant's input: a fresh command, else the backup policy or the plan, else the plant's safe input."""

from __future__ import annotations

import math
from collections.abc import Callable
from copy import copy
from dataclasses import dataclass

import numpy as np

from lbmpc.plants import Description
from protocol.messages import Backup, Command, InputSource

Measure = Callable[[], np.ndarray | None]
"""x, (d,), of this moment, NaN for a state of which no number came; None where none of it can be measured. Called only
by what depends on it."""


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """What acts from some moment on."""

    u: np.ndarray
    """(m,), in U."""
    source: InputSource
    until: float
    """When something else takes over if no command comes; infinite where nothing does."""


class Standby:
    """A backup policy and when its command began to act; immutable. Times in seconds."""

    def __init__(self, backup: Backup, arrived: float):
        """`backup` must have the plant's dimensions."""
        self._arrived = arrived
        self._period = backup.period
        self._inputs = backup.inputs
        self._gain = np.array(backup.gain)

    def drive(self, t: float, measure: Measure) -> tuple[np.ndarray, float] | None:
        """What it wants at time t, and until when.

        None before its first entry, behind its last, where the state is not known, and where its numbers, each of them
        finite, add up to none.
        """
        entry = _elapsed(self._arrived, t, self._period)
        if not 1 <= entry <= len(self._inputs) or (x := measure()) is None:
            return None
        with np.errstate(over="ignore", invalid="ignore"):
            u = self._inputs[entry - 1] + self._gain @ x
        return (u, self._arrived + (entry + 1) * self._period) if np.isfinite(u).all() else None


class Orders:
    """The last command and what follows from it as time goes by; immutable. Times in seconds.

    The command's input acts for `patience` periods from its arrival. Then, in each period, the backup policy
    acts while it has an entry, the plan's entry while it has one, and the plant's safe input for ever after.
    """

    def __init__(self, plant: Description, command: Command, arrived: float, patience: float):
        """`command` must have the plant's dimensions; what acts of it is brought into U."""
        self.run_id, self.seq = command.run_id, command.seq
        self.arrived = arrived
        self._period = command.period
        self._patience_ends = arrived + patience * command.period
        self._plant = plant
        self._plan = [command.u, *command.plan[1:]]
        self._first = plant.within(command.u)

    def without_plan(self) -> Orders:
        """The same command, after which the safe input follows."""
        alone = copy(self)
        alone._plan = self._plan[:1]
        return alone

    def drive(self, t: float, measure: Measure, standby: Standby | None = None) -> Drive:
        """What acts at time t, `arrived` or later."""
        if self._patience_ends > _reached(t, self._period):
            return Drive(self._first, "command", self._patience_ends)
        if standby is not None and (backup := standby.drive(t, measure)) is not None:
            return Drive(self._plant.within(backup[0]), "plan", backup[1])
        entry = _elapsed(self.arrived, t, self._period)
        ends = self.arrived + (entry + 1) * self._period
        if entry < len(self._plan):
            # Entry by entry, as they are needed: most plans are never followed beyond their first.
            return Drive(self._plant.within(self._plan[entry]), "plan", ends)
        return safe_drive(self._plant, measure, ends)


def safe_drive(plant: Description, measure: Measure, ends: float) -> Drive:
    """The safe input; of one that depends on the state: until `ends`, and without its feedback where none is known."""
    if plant.safe_gain is None:
        return Drive(plant.within(plant.safe_input), "safe", math.inf)
    x = measure()
    u = plant.safe_input if x is None or not np.isfinite(x).all() else plant.safe_input_at(x)
    return Drive(plant.within(u), "safe", ends)


def _reached(t: float, period: float) -> float:
    """t, and a little more: a switching time that rounding put a hair too late still counts as reached."""
    return t + 1e-9 * period + 4 * math.ulp(t)


def _elapsed(since: float, t: float, period: float) -> int:
    """Whole periods from `since` to t, so that the next one ends later than t."""
    entry = max(0, math.floor((t - since) / period))
    while since + (entry + 1) * period <= _reached(t, period):
        entry += 1
    return entry
