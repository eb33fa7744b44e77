"""The plant that a configuration names: it exists, and every vector of the configuration has its lengths.

Whoever asks hands over the function that finds a plant by name; nothing of the science is imported here.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol, Self, TypeVar

import numpy as np

from node_runtime.config.sections import Config
from node_runtime.config.strict import ConfigError


class Described(Protocol):
    """What the checks need to know of a plant."""

    @property
    def name(self) -> str: ...
    @property
    def states(self) -> Sequence[str]: ...
    @property
    def inputs(self) -> Sequence[str]: ...
    @property
    def x0(self) -> np.ndarray: ...


class Plant(Described, Protocol):
    """One whose parameters may be told to differ."""

    def varied(self, **changes: float) -> Self: ...


P = TypeVar("P", bound=Plant)


def plant_of(config: Config, find: Callable[[str], P]) -> P:
    """The plant that `config` names, as its model knows it, with every length and name in `config` checked against it.

    Args:
        find: `lbmpc.plants.get_plant`; raises LookupError with a text for a plant that is unknown or cannot be used.

    Raises:
        ConfigError: a plant that is unknown or cannot be used, an unknown variable or parameter, or a vector of the
            wrong length; names the key and the rule.
    """
    return _model_and_truth(config, find)[0]


def true_plant_of(config: Config, find: Callable[[str], P]) -> P:
    """The plant as it really moves: `plant_of` with the parameters of `plant.truth`. Raises as `plant_of` does."""
    return _model_and_truth(config, find)[1]


def _model_and_truth(config: Config, find: Callable[[str], P]) -> tuple[P, P]:
    try:
        plant = find(config.plant.model)
    except LookupError as error:
        raise ConfigError(f"plant.model = {config.plant.model!r}: {error.args[0]}") from error
    for key, values, what, names in (
        ("plant.x0", config.plant.x0, "states", plant.states),
        ("controller.W", config.controller.W, "states", plant.states),
        ("controller.Q", config.controller.Q, "states", plant.states),
        ("controller.R", config.controller.R, "inputs", plant.inputs),
    ):
        if values is not None and len(values) != len(names):
            rule = f"{plant.name} has {len(names)} {what} ({', '.join(names)})"
            raise ConfigError(f"{key} has {len(values)} entries; {rule}")
    known = (*plant.states, *plant.inputs)
    for name in config.l2nw.variables or []:
        if name not in known:
            raise ConfigError(f"l2nw.variables: {name!r} is not one of {plant.name}'s {', '.join(known)}")
    if config.l2nw.variables is not None and not config.l2nw.variables:
        raise ConfigError(f"l2nw.variables is empty; the kernel needs at least one of {', '.join(known)}")
    try:
        return plant, plant.varied(**config.plant.truth) if config.plant.truth else plant
    except (LookupError, ArithmeticError) as error:
        raise ConfigError(f"plant.truth: {error.args[0]}") from error


def initial_state(config: Config, plant: Described) -> np.ndarray:
    """The configuration's x0, or the plant's own where it has none; (d,), plant units. Lengths as `plant_of` checks."""
    return np.array(plant.x0 if config.plant.x0 is None else config.plant.x0, dtype=float)
