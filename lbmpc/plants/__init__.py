"""Plants by name. To add one, write a file and add it to the list below."""

from __future__ import annotations

import difflib
from collections.abc import Callable

from lbmpc.plants.description import Description, PlantDefinitionError, PlantError
from lbmpc.plants.equations import Domain, Plant, Rhs
from lbmpc.plants.inspection import has_form, require_equations, require_sound
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
    "get_truth",
    "true_motion",
]


def get_plant(
    which: str | Known | Plant, change: Callable[[Known | Plant], Known | Plant] | None = None
) -> Known | Plant:
    """Return a plant after checking it.

    Args:
        which: its name, or a plant of your own.
        change: a change that is applied before the check, if the plant's form is valid (`has_form`).

    Raises:
        LookupError: `KeyError` with the nearest known name, or `PlantDefinitionError` with the faults of the plant.
    """
    plant = _named(which)
    if change is not None and has_form(plant):
        plant = change(plant)
    require_sound(plant)
    return plant


def get_truth(which: str | Known | Plant) -> Known | Plant:
    """Return a plant that is only simulated, after checking its names and equations. Raises as `get_plant` does."""
    plant = _named(which)
    require_equations(plant)
    return plant


def _named(which: str | Known | Plant) -> Known | Plant:
    try:
        return PLANTS[which] if isinstance(which, str) else which
    except KeyError:
        near = difflib.get_close_matches(str(which), PLANTS, n=1, cutoff=0.0)
        raise KeyError(f"no plant is called {which!r}; did you mean {near[0]!r}?") from None
