"""What a configuration must also satisfy for one plant: its name exists, and vectors have its lengths."""

from __future__ import annotations

from lbmpc.plants import Plant, get_plant
from node_runtime.config.sections import Config
from node_runtime.config.strict import ConfigError


def plant_of(config: Config) -> Plant:
    """The plant that `config` names, with every length in `config` checked against it.

    Raises:
        ConfigError: a plant that is unknown or cannot be used, an unknown variable, or a vector of the wrong length;
            names the key and the rule.
    """
    try:
        plant = get_plant(config.plant.model)
    except LookupError as error:
        raise ConfigError(f"plant.model = {config.plant.model!r}: {error.args[0]}") from error
    states, inputs = ", ".join(plant.states), ", ".join(plant.inputs)
    vectors = [
        ("plant.x0", config.plant.x0, plant.d, f"states ({states})"),
        ("controller.W", config.controller.W, plant.d, f"states ({states})"),
        ("controller.Q", config.controller.Q, plant.d, f"states ({states})"),
        ("controller.R", config.controller.R, plant.m, f"inputs ({inputs})"),
    ]
    for key, values, length, what in vectors:
        if values is not None and len(values) != length:
            raise ConfigError(f"{key} has {len(values)} entries; {plant.name} has {length} {what}")
    known = (*plant.states, *plant.inputs)
    for name in config.l2nw.variables or []:
        if name not in known:
            raise ConfigError(f"l2nw.variables: {name!r} is not one of {plant.name}'s {', '.join(known)}")
    if config.l2nw.variables is not None and not config.l2nw.variables:
        raise ConfigError(f"l2nw.variables is empty; the kernel needs at least one of {', '.join(known)}")
    return plant
