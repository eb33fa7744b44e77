"""Checks a requested `Reference` in plant units against the plant, and converts it to a `Change`."""

from __future__ import annotations

import hashlib
import math
from functools import lru_cache
from itertools import pairwise

import numpy as np

from lbmpc.plants import Description
from lbmpc.references import FOR_EVER, Change
from protocol import messages as m

LATEST = 1e6
"""Latest time of a trajectory's last point, in seconds from now."""
FARTHEST = 1e6
"""Largest distance of a reference from the equilibrium in half-widths, for states without a bound in X."""


class RefusedReference(ValueError):
    """A reference that is not valid for this plant. The text says why."""


def change_of(reference: m.Reference, plant: Description, period: float) -> Change:
    """Convert a reference for a controller of this plant; `period` in seconds.

    Raises:
        RefusedReference: the reference is not valid.
    """
    lease = FOR_EVER
    if reference.lease is not None:
        _require(0.0 < reference.lease <= LATEST, f"lease = {reference.lease:g} s")
        lease = max(1, math.ceil(reference.lease / period - 1e-9))
    source = source_of(reference.run_id)
    if reference.kind != "set":
        _require(
            not (reference.outputs or reference.times or reference.values),
            f"{reference.kind} has no outputs, times or values",
        )
        return Change(reference.kind, lease=lease, source=source)
    names, times, values = reference.outputs, reference.times, reference.values
    for name in names:
        _require(
            name in plant.states, f"{name[:40]!r} is no state of {plant.name}: {', '.join(plant.states)}"
        )
    _require(0 < len(names) == len(set(names)), "outputs are named once each, and there is at least one")
    _require(
        0 < len(times) == len(values) <= m.MOST_POINTS,
        f"{len(times)} times and {len(values)} values: as many of each, 1 to {m.MOST_POINTS}",
    )
    _require(
        all(len(row) == len(names) for row in values), "each of the values has one number for each output"
    )
    _require(
        all(map(math.isfinite, times)) and all(math.isfinite(v) for row in values for v in row),
        "times and values are finite numbers",
    )
    _require(times[0] >= 0.0, f"it begins {-times[0]:g} s ago: times count from now on")
    _require(
        all(a <= b for a, b in pairwise(times)),
        "times fall: each is at least the one before",
    )
    _require(times[-1] <= LATEST, f"it ends in {times[-1]:g} s: at most {LATEST:g}")
    outputs = [plant.states.index(name) for name in names]
    points = np.array(values, dtype=float)
    room = FARTHEST * plant.x_scale
    low, high = np.maximum(plant.x_min, plant.x_e - room), np.minimum(plant.x_max, plant.x_e + room)
    beyond = np.maximum(low[outputs] - points, points - high[outputs])
    for column, i in enumerate(outputs):
        worst = points[beyond[:, column].argmax(), column]
        _require(
            low[i] <= worst <= high[i],
            f"{plant.states[i]} = {worst:g} is outside X: {low[i]:g} to {high[i]:g}",
        )
    return Change(
        "set", (*outputs,), np.array(times, dtype=float), points - plant.x_e[outputs], lease, source
    )


def verdict_on(reference: m.Reference, plant: Description, period: float) -> str:
    """Return the verdict for a `TickResult`: "taken", or "refused: " and the reason."""
    try:
        change_of(reference, plant, period)
    except RefusedReference as error:
        return f"refused: {error}"
    return "taken"


def _require(holds: bool, otherwise: str) -> None:
    if not holds:
        raise RefusedReference(otherwise)


@lru_cache(maxsize=16)
def source_of(run_id: str) -> int:
    """Return a number for a run id, the same in every process."""
    return int.from_bytes(hashlib.sha256(run_id.encode()).digest()[:7], "little")
