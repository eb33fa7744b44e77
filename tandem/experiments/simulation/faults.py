"""Faults of a run that occur in practice and are not in the paper."""

from __future__ import annotations

import numpy as np

from lbmpc.plants import Known, Plant, TrueMotion
from node_runtime.config.sections import NonNegative, Section

RAMP_PIECES = 20


class Drift(Section, frozen=True):
    """The true plant's parameters change linearly in time and stay at their final values; the model does not change."""

    to: dict[str, float]
    """Final values by name, of the plant's `parameters`."""
    at: NonNegative
    """Seconds."""
    over: NonNegative = 0.0
    """Duration of the change in seconds; 0: a step."""

    def plants(self, plant: Known | Plant | TrueMotion) -> list[tuple[float, Plant]]:
        """Return (start time, plant), a ramp in `RAMP_PIECES` steps. Raises `KeyError` for an unknown parameter."""
        if not isinstance(plant, Plant):
            raise KeyError("the true plant has no equations, and so no parameter can drift")
        pieces = RAMP_PIECES if self.over > 0 else 1
        made = []
        for share in (np.arange(1, pieces + 1) / pieces).tolist():
            values = {
                name: (1 - share) * plant.parameters.get(name, 0.0) + share * value
                for name, value in self.to.items()
            }
            made.append((self.at + share * self.over, plant.varied(**values)))
        return made


class Faults(Section, frozen=True):
    """None by default."""

    command_seconds: NonNegative = 0.0
    """Seconds from a sample until its command acts, as live; less than a period."""
    training_seconds: NonNegative = 0.0
    """Duration of a training in seconds; none begins during another one."""
    trainer_dies_at: NonNegative | None = None
    """Seconds at which the trainer dies; weights that it had not sent by then are lost."""
    drift: Drift | None = None
