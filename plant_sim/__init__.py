"""The process at the plant: a gateway around a machine's two functions, and the simulated plant as such a machine."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from plant_sim.gateway import Gateway

__all__ = ["Gateway"]


def __getattr__(name: str) -> Any:
    """Import an exported name on first use, because lock-step needs no bus."""
    if name != "Gateway":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from plant_sim.gateway import Gateway

    return Gateway
