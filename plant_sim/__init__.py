"""The process at the plant: a gateway around two functions of a machine's, and the simulated plant that is one such."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from plant_sim.gateway import Gateway

__all__ = ["Gateway"]


def __getattr__(name: str) -> Any:
    """What is exported, imported where it is used: lock-step needs no bus."""
    if name != "Gateway":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from plant_sim.gateway import Gateway

    return Gateway
