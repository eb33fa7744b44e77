"""Plants by name. Add yours: one file, one line here."""

from __future__ import annotations

import difflib

from lbmpc.plants.description import Description, PlantDefinitionError, PlantError
from lbmpc.plants.equations import Domain, Plant, Rhs
from lbmpc.plants.inspection import require_sound
from lbmpc.plants.known import Known
from lbmpc.plants.moore_greitzer import MOORE_GREITZER
from lbmpc.plants.truth import TrueMotion, Truth, true_motion

PLANTS: dict[str, Known | Plant] = {plant.name: plant for plant in (MOORE_GREITZER,)}

__all__ = [
    "PLANTS",
    "Description",
    "Domain",
    "Known",
    "Plant",
    "PlantDefinitionError",
    "PlantError",
    "Rhs",
    "TrueMotion",
    "Truth",
    "get_plant",
    "true_motion",
]


def get_plant(name: str) -> Known | Plant:
    """The plant of that name, looked at.

    Raises:
        LookupError: `KeyError` with the nearest known name, or `PlantDefinitionError` with what is wrong with it.
    """
    try:
        plant = PLANTS[name]
    except KeyError:
        near = difflib.get_close_matches(name, PLANTS, n=1, cutoff=0.0)
        raise KeyError(f"no plant is called {name!r}; did you mean {near[0]!r}?") from None
    require_sound(plant)
    return plant
