"""Finds the configured plant, and checks every vector and name of the configuration against it.

The caller passes the function that finds a plant, so that this module does not import `lbmpc`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol, Self, TypeVar

import msgspec
import numpy as np

from node_runtime.config.reference import is_reference, load, sha256_of, sha256_of_imports
from node_runtime.config.sections import DEAD_TIME, Config, ReferenceConfig, Shares
from node_runtime.config.strict import ConfigError, did_you_mean

Row = Mapping[str, float]
"""See `lbmpc.plants.description.Description.rows`."""


class Described(Protocol):
    """The part of a plant's description that the checks need."""

    @property
    def name(self) -> str: ...
    @property
    def states(self) -> Sequence[str]: ...
    @property
    def inputs(self) -> Sequence[str]: ...
    @property
    def x_e(self) -> np.ndarray: ...
    @property
    def u_e(self) -> np.ndarray: ...
    @property
    def x_min(self) -> np.ndarray: ...
    @property
    def x_max(self) -> np.ndarray: ...
    @property
    def u_min(self) -> np.ndarray: ...
    @property
    def u_max(self) -> np.ndarray: ...
    @property
    def input_rates(self) -> np.ndarray: ...
    @property
    def rows(self) -> Mapping[str, Row]: ...
    @property
    def W(self) -> np.ndarray: ...
    @property
    def x0(self) -> np.ndarray: ...
    @property
    def dead_time(self) -> float: ...


class Plant(Described, Protocol):
    """A described plant that can be changed."""

    def changed(
        self,
        bounds: Mapping[str, Sequence[float | None]],
        x_e: Sequence[float] | None = None,
        u_e: Sequence[float] | None = None,
        dead_time: float | None = None,
        input_rate_max: Mapping[str, float] | None = None,
        rows: Mapping[str, Row] | None = None,
    ) -> Self: ...
    def varied(self, **changes: float) -> Self: ...


class Motion(Protocol):
    """A user's object that simulates the plant."""

    def step(self, x: np.ndarray, u: np.ndarray, dt: float) -> np.ndarray: ...


P = TypeVar("P", bound=Plant)
Find = Callable[[Any, Callable[[P], P]], P]
"""`lbmpc.plants.get_plant`: takes a name or a plant and a change that is applied before the check, returns the plant,
and raises `LookupError` with a text for a plant that is unknown or cannot be used."""


def plant_of(config: Config, find: Find[P], plant: Described | None = None) -> P:
    """Return the plant of `config` as its model knows it, after checking every length and name in `config` against it.

    Args:
        config: the configuration.
        find: `lbmpc.plants.get_plant`.
        plant: used instead of the configured plant, for example from a log; nothing is loaded then.

    Raises:
        ConfigError: the plant is unknown or cannot be used, a variable or parameter is unknown, or a vector has a wrong
            length. The text names the key and the rule.
    """
    named = config.plant.model
    try:
        which = plant if plant is not None else load_plant(named) if is_reference(named) else named
    except ConfigError as error:
        raise ConfigError(f"plant.model: {error}") from error
    try:
        found = find(which, lambda plant: _as_configured(config, plant))
    except LookupError as error:
        raise ConfigError(f"plant.model = {named!r}: {error.args[0]}") from error
    if plant is None:
        _with_parameters(config, found)
    _check_reference(config.reference, found)
    _check_names_of_states(config, found)
    return found


def true_plant_of(
    config: Config, find: Find[P], find_truth: Callable[[Any], P], plant: Described | None = None
) -> P | Motion:
    """Return the true plant: `plant_of` with the parameters of `plant.truth`, or the object that `plant.truth` names.

    Args:
        config: the configuration.
        find, plant: as for `plant_of`.
        find_truth: `lbmpc.plants.get_truth`.

    Raises:
        ConfigError: as for `plant_of`; or `plant.truth` names no plant or motion, or one with other states or inputs.
    """
    model, truth = plant_of(config, find, plant), config.plant.truth
    if not isinstance(truth, str):
        return _with_parameters(config, model)
    try:
        found = load(truth, _moves, "plant or object with step") if is_reference(truth) else truth
        if hasattr(found, "step"):
            return found
        true = find_truth(found)
    except ConfigError as error:
        raise ConfigError(f"plant.truth: {error}") from error
    except LookupError as error:
        raise ConfigError(f"plant.truth = {truth!r}: {error.args[0]}") from error
    for what, ours, theirs in (
        ("states", model.states, true.states),
        ("inputs", model.inputs, true.inputs),
    ):
        if tuple(ours) != tuple(theirs):
            raise ConfigError(
                f"plant.truth = {truth!r}: its {what} are {', '.join(theirs)}, and those of the model "
                f"{', '.join(ours)}; both need the same names in the same order"
            )
    return true


def true_dead_time(config: Config, known: Described, true: object) -> float:
    """Return the true dead time in seconds: from `plant.truth`, from the object it names, or else the known one.

    known, true: results of `plant_of` and `true_plant_of`.
    """
    truth = config.plant.truth
    if isinstance(truth, dict) and DEAD_TIME in truth:
        return truth[DEAD_TIME]
    own: float = getattr(true, DEAD_TIME, 0.0)
    return own or known.dead_time


def load_plant(reference: str) -> Any:
    """Load the plant of a reference such as "tanks.py:TANKS", unchanged. Raises `ConfigError`."""
    return load(reference, _is_plant, "plant")


def files_of(config: Config) -> dict[str, str]:
    """Return the SHA-256 of the user's files in `config`, for files that exist here.

    The key of a file is its key in `config`. Files that it imports from its folder have "plant.model: NAME.py".
    """
    named = {
        "plant.model": config.plant.model,
        "plant.truth": config.plant.truth,
        "network.architecture": config.network.architecture,
    }
    references = {key: text for key, text in named.items() if isinstance(text, str) and is_reference(text)}
    found = {}
    for key, text in references.items():
        if (sha256 := sha256_of(text)) is not None:
            found[key] = sha256
            found |= {f"{key}: {name}": theirs for name, theirs in sha256_of_imports(text).items()}
    return found


def spelt_out(config: Config, plant: Described) -> Config:
    """Return the configuration with all properties of `plant`, so that the run does not depend on its file."""
    bounds = {
        name: [low if np.isfinite(low) else None, high if np.isfinite(high) else None]
        for names, lows, highs in (
            (plant.states, plant.x_min, plant.x_max),
            (plant.inputs, plant.u_min, plant.u_max),
        )
        for name, low, high in zip(names, lows.tolist(), highs.tolist(), strict=True)
    }
    limits = zip(plant.inputs, plant.input_rates.tolist(), strict=True)
    rates = {name: rate for name, rate in limits if np.isfinite(rate)}
    settings = config.controller
    return msgspec.structs.replace(
        config,
        plant=msgspec.structs.replace(
            config.plant,
            x0=initial_state(config, plant).tolist(),
            x_e=plant.x_e.tolist(),
            u_e=plant.u_e.tolist(),
            bounds=bounds,
            dead_time=plant.dead_time,
            input_rate_max=rates,
            rows={name: dict(row) for name, row in plant.rows.items()},
        ),
        controller=msgspec.structs.replace(
            settings,
            W=plant.W.tolist() if settings.W is None else settings.W,
            Q=[1.0] * len(plant.states) if settings.Q is None else settings.Q,
            R=[1.0] * len(plant.inputs) if settings.R is None else settings.R,
        ),
    )


def initial_state(config: Config, plant: Described) -> np.ndarray:
    """Return the configured x0, or the plant's own; (d,), in plant units. `plant_of` checks its length."""
    return np.array(plant.x0 if config.plant.x0 is None else config.plant.x0, dtype=float)


def _is_plant(value: Any) -> bool:
    return not isinstance(value, type) and all(hasattr(value, name) for name in ("states", "inputs", "x_e"))


def _moves(value: Any) -> bool:
    return _is_plant(value) or (not isinstance(value, type) and callable(getattr(value, "step", None)))


def _as_configured(config: Config, plant: P) -> P:
    """Return the plant with the bounds, rows and equilibrium of the configuration."""
    known = (*plant.states, *plant.inputs)
    for key, values, what, names in (
        ("plant.x0", config.plant.x0, "states", plant.states),
        ("plant.x_e", config.plant.x_e, "states", plant.states),
        ("plant.u_e", config.plant.u_e, "inputs", plant.inputs),
        ("controller.W", config.controller.W, "states", plant.states),
        ("controller.Q", config.controller.Q, "states", plant.states),
        ("controller.R", config.controller.R, "inputs", plant.inputs),
        ("controller.S", config.controller.S, "inputs", plant.inputs),
    ):
        if values is not None and len(values) != len(names):
            rule = f"{plant.name} has {len(names)} {what} ({', '.join(names)})"
            raise ConfigError(f"{key} has {len(values)} entries; {rule}")
    for name in config.l2nw.variables or []:
        if name not in known:
            raise ConfigError(f"l2nw.variables: {name!r} is not one of {plant.name}'s {', '.join(known)}")
    if config.l2nw.variables is not None and not config.l2nw.variables:
        raise ConfigError(f"l2nw.variables is empty; the kernel needs at least one of {', '.join(known)}")
    for name in config.plant.bounds:
        if name not in known:
            hint = did_you_mean(name, known, f"it has {', '.join(known)}")
            raise ConfigError(f"plant.bounds: {plant.name} has no state or input {name!r}; {hint}")
    rates = config.plant.input_rate_max
    for name in rates:
        if name not in plant.inputs:
            hint = did_you_mean(name, plant.inputs, f"it has {', '.join(plant.inputs)}")
            raise ConfigError(f"plant.input_rate_max: {plant.name} has no input {name!r}; {hint}")
    there = config.plant
    return plant.changed(there.bounds, there.x_e, there.u_e, there.dead_time, rates, there.rows)


def _check_reference(reference: ReferenceConfig, plant: Described) -> None:
    outputs, values = reference.outputs or [], reference.values
    for i, name in enumerate(outputs):
        if name not in plant.states:
            hint = did_you_mean(name, plant.states, f"it has {', '.join(plant.states)}")
            raise ConfigError(f"reference.outputs: {plant.name} has no state {name!r}; {hint}")
        if name in outputs[:i]:
            raise ConfigError(f"reference.outputs: {name!r} is used twice")
    if values is None:
        return
    if len(values) != len(outputs):
        there = (
            f"reference.outputs has {len(outputs)} ({', '.join(outputs)})"
            if outputs
            else "no reference.outputs"
        )
        raise ConfigError(f"reference.values has {len(values)} entries; {there}: give one for each output")
    for name, value in zip(outputs, values, strict=True):
        i = list(plant.states).index(name)
        if not plant.x_min[i] <= value <= plant.x_max[i]:
            raise ConfigError(
                f"reference.values: {name} = {value:g} is outside X, {plant.x_min[i]:g} to {plant.x_max[i]:g}"
            )


def _check_names_of_states(config: Config, plant: Described) -> None:
    sensors, estimator = config.plant.sensors, config.estimator
    for key, names in (
        ("plant.sensors.noise", sensors.noise),
        ("plant.sensors.quantisation", sensors.quantisation),
        ("plant.sensors.bias", sensors.bias),
        ("plant.sensors.stuck", sensors.stuck),
        ("plant.sensors.dead", sensors.dead),
        ("estimator.noise", estimator.noise),
        ("estimator.process", estimator.process),
        ("estimator.measured", estimator.measured),
    ):
        for name in names if isinstance(names, list | dict) else ():
            if name not in plant.states:
                hint = did_you_mean(name, plant.states, f"it has {', '.join(plant.states)}")
                raise ConfigError(f"{key}: {plant.name} has no state {name!r}; {hint}")
    if estimator.measured is not None and not estimator.measured:
        raise ConfigError("estimator.measured is empty: give the measured states")


def in_half_widths(shares: Shares, plant: Described) -> np.ndarray:
    """Return one share per state, (d,)."""
    if isinstance(shares, dict):
        return np.array([shares.get(name, 0.0) for name in plant.states], dtype=float)
    return np.full(len(plant.states), float(shares))


def _with_parameters(config: Config, plant: P) -> P:
    truth = config.plant.truth
    others = (
        {name: value for name, value in truth.items() if name != DEAD_TIME} if isinstance(truth, dict) else {}
    )
    try:
        return plant.varied(**others) if others else plant
    except (LookupError, ArithmeticError) as error:
        raise ConfigError(f"plant.truth: {error.args[0]}") from error
