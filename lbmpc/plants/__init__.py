"""Plants by name. Add yours: one file, one line here."""

from __future__ import annotations

import difflib

from lbmpc.plants.base import Plant, PlantError, Truth
from lbmpc.plants.moore_greitzer import MOORE_GREITZER

PLANTS: dict[str, Plant] = {plant.name: plant for plant in (MOORE_GREITZER,)}

__all__ = ["PLANTS", "Plant", "PlantError", "Truth", "get_plant"]


def get_plant(name: str) -> Plant:
    """The plant of that name. Raises `KeyError` with the nearest known name."""
    try:
        return PLANTS[name]
    except KeyError:
        near = difflib.get_close_matches(name, PLANTS, n=1, cutoff=0.0)
        raise KeyError(f"no plant is called {name!r}; did you mean {near[0]!r}?") from None
