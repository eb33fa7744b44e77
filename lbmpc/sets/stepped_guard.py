"""The guard of runs that were recorded before docs/decisions/0030: kept so that their logs replay."""

from __future__ import annotations

import numpy as np

from lbmpc.sets.guard import Bounds, Guard, InputRows

RESERVES = (0.02, 0.005, 0.001, 0.0)
"""Distances from the target's boundary, as shares of X's half-widths; the first that some input keeps is kept."""


class SteppedGuard(Guard):
    """Falls back to no distance at all where 0.001 cannot be kept, and says nothing outside."""

    def _inside(self, rows: InputRows, x: np.ndarray) -> Bounds | None:
        room = rows.room(x)
        return next(
            (found for reserve in RESERVES if (found := rows.within(room, reserve)) is not None), None
        )

    def _outside(self, rows: InputRows, x: np.ndarray) -> tuple[None, None]:
        return None, None
