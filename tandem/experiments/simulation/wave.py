"""A periodic sequence of set-points, and the cost of a run above the true plant's equilibria there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.optimize import root

from lbmpc.plants import Description, PlantError, TrueMotion
from node_runtime.config.strict import ConfigError, did_you_mean
from protocol import messages as m
from tandem.operating.set_points import trajectory

Values = Mapping[str, Sequence[float]]
"""Set-points by state name, plant units: the values of a cycle, each of equal duration."""
CLOSE = 1e-8
"""Tolerance in half-widths for the motion at an equilibrium in one period, and for its distance from the set-point."""


def require_fit(values: Values, plant: Description, where: str) -> None:
    """Raise `ConfigError` for an invalid wave of this plant; the text begins with `where`."""
    states = plant.states
    for name in values:
        if name not in states:
            raise ConfigError(
                f"{where}: {name!r} is no state; {did_you_mean(name, states, ', '.join(states))}"
            )
    if (
        len(values) != plant.m
        or len({len(every) for every in values.values()}) != 1
        or not all(values.values())
    ):
        raise ConfigError(
            f"{where}: give as many states as the plant has inputs ({plant.m}), each with the same number of values"
        )
    for name, every in values.items():
        i = states.index(name)
        if not all(plant.x_min[i] <= value <= plant.x_max[i] for value in every):
            raise ConfigError(f"{where}: {name} = {[*every]} is not within its bounds")


def reference(values: Values, seconds: float, cycles: int) -> m.Reference:
    """Return the reference of `cycles` cycles of `seconds`, and one more for the preview of the last plans."""
    parts = len(next(iter(values.values())))
    turns = np.arange((cycles + 1) * parts)
    times = np.repeat(seconds / parts * np.append(turns, turns[-1] + 1), 2)[1:-1]
    return trajectory(
        times.tolist(),
        {name: np.repeat(np.tile(every, cycles + 1), 2).tolist() for name, every in values.items()},
    )


def rests(
    values: Values, steps: int, true: TrueMotion, plant: Description, period: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the true plant's equilibrium at each tick of a cycle: (steps, d) and (steps, m), plant units.

    values: checked by `require_fit`. With as many outputs as inputs an equilibrium is unique.

    Raises:
        PlantError: there is no equilibrium at a set-point.
    """
    own = [plant.states.index(name) for name in values]
    found = [_rest(np.array(row), own, true, plant, period) for row in zip(*values.values(), strict=True)]
    turn = np.arange(steps) * len(found) // steps
    x, u = (np.array(of) for of in zip(*found, strict=True))
    return x[turn], u[turn]


def _rest(
    r: np.ndarray, own: list[int], true: TrueMotion, plant: Description, period: float
) -> tuple[np.ndarray, np.ndarray]:
    x_scale, u_scale = plant.x_scale, plant.u_scale

    def off(v: np.ndarray) -> np.ndarray:
        x, u = plant.x_e + v[: plant.d] * x_scale, plant.u_e + v[plant.d :] * u_scale
        return np.append((true.step(x, u, period) - x) / x_scale, (x[own] - r) / x_scale[own])

    found = root(off, np.zeros(plant.d + plant.m), tol=1e-12)
    if not np.abs(off(found.x)).max() < CLOSE:
        raise PlantError(
            f"the true plant has no steady state with {', '.join(plant.states[i] for i in own)} at {r.tolist()}"
        )
    return plant.x_e + found.x[: plant.d] * x_scale, plant.u_e + found.x[plant.d :] * u_scale
