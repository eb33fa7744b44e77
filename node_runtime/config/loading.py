"""Reads, checks and writes configurations: TOML files, shipped names, overrides, and the JSON of a log."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import tomli_w

from network_model.operations import BOUNDED
from network_model.registry import get_architecture
from node_runtime.config import strict
from node_runtime.config.reference import absolute, is_reference
from node_runtime.config.sections import (
    DEAD_TIME,
    LONGEST_HORIZON,
    LONGEST_PERIOD,
    MOST_DEAD_PERIODS,
    Config,
    NetworkConfig,
    Section,
)
from node_runtime.config.shipped import config_file
from node_runtime.config.strict import ConfigError, Fail
from protocol.codec import first_non_finite

INFINITE = -math.inf, math.inf
"""Lower and upper bounds that mean no bound."""


def load(path: str | Path | None = None, overrides: list[str] | None = None) -> Config:
    """Read a TOML file, or the shipped configuration of that name, and apply `section.key=value` overrides.

    With `path` None all values are defaults.

    Raises:
        ConfigError: the file cannot be read, its TOML is not valid, or a key is unknown, of a wrong type or out of
        range.
    """
    if path is None:
        return _overridden({}, overrides or [], "configuration")
    file = config_file(path)
    return _overridden(strict.load_tree(file), overrides or [], str(path), file.parent)


def override(config: Config, assignments: list[str]) -> Config:
    """Return a copy with `section.key=value` assignments applied. Raises `ConfigError`."""
    return _overridden(to_tree(config), assignments, "configuration")


def _overridden(
    tree: dict[str, Any], assignments: list[str], where: str, folder: Path | None = None
) -> Config:
    origins = {strict.apply_override(tree, text): f"--set {text}" for text in assignments}
    return from_tree(tree, where, origins, folder)


def from_tree(
    tree: dict[str, Any],
    where: str = "configuration",
    origins: Mapping[str, str] | None = None,
    folder: Path | None = None,
    origins_folder: Path | None = None,
) -> Config:
    """Convert a plain tree to a `Config`. Raises `ConfigError`.

    `~` at the beginning of a path is replaced by the home folder. References to files become absolute.

    Args:
        tree: tables as read from TOML.
        where: the file's name for messages.
        origins: origin of keys that are not from the file, by key (such as `trainer.batch`).
        folder: base of relative references; None leaves them unchanged.
        origins_folder: the same for keys in `origins`; None for the current folder.
    """
    fail = strict.failing(where, origins)
    config = _with_home_folder(_checked(tree, where, origins), fail)
    places = {**dict.fromkeys(origins or {}, origins_folder or Path.cwd()), "": folder}
    return _with_absolute_references(config, fail, places)


def _checked(tree: dict[str, Any], where: str, origins: Mapping[str, str] | None = None) -> Config:
    """Return the tree as a `Config` with unchanged paths."""
    fail = strict.failing(where, origins)
    config = strict.convert(_with_open_bounds(tree), Config, fail)
    _check_texts(tree, fail)
    infinite = first_non_finite(config)
    if infinite is not None:
        fail(infinite, f"{infinite} is not a finite number")
    if config.period > LONGEST_PERIOD:
        fail("rate", f"rate = {config.rate}: a period of {config.period:g} s; at most {LONGEST_PERIOD:g} s")
    activation = config.network.activation
    if activation not in BOUNDED:
        fail(
            "network.activation",
            f"network.activation = {activation!r} is not bounded, but the last layer must be; use "
            f"one of {', '.join(BOUNDED)}",
        )
    _check_architecture(config.network, fail)
    config = _with_horizon(config, tree, fail, origins or {})
    delay = config.controller.input_delay_ms
    if delay is not None and delay > 500.0 * config.period:
        fail(
            "controller.input_delay_ms",
            f"controller.input_delay_ms = {delay:g} is more than half a period, {500.0 * config.period:g} ms at "
            f"rate = {config.rate:g} Hz: the state cannot be predicted over a longer delay",
        )
    truth, most = config.plant.truth, MOST_DEAD_PERIODS * config.period
    if isinstance(truth, dict) and not 0.0 <= (seconds := truth.get(DEAD_TIME, 0.0)) <= most * (1.0 + 1e-9):
        fail(
            "plant.truth",
            f"plant.truth.{DEAD_TIME} = {seconds:g} s is out of range: 0 to {most:g} s ({MOST_DEAD_PERIODS} periods)",
        )
    if config.trainer.min_samples > config.trainer.capacity:
        fail(
            "trainer.min_samples",
            f"trainer.min_samples = {config.trainer.min_samples} exceeds trainer.capacity = "
            f"{config.trainer.capacity}: training would never start",
        )
    for i, place in enumerate(config.trainer.fleet):
        if place.name in {earlier.name for earlier in config.trainer.fleet[:i]}:
            fail(f"trainer.fleet[{i}].name", f"trainer.fleet[{i}].name = {place.name!r} is used twice")
    return config


def _with_horizon(config: Config, tree: dict[str, Any], fail: Fail, origins: Mapping[str, str]) -> Config:
    """Convert `horizon_seconds` to steps. If both keys are given, one from `origins` overrides one from the file."""
    controller = config.controller
    seconds, named = controller.horizon_seconds, "controller.horizon_seconds"
    if seconds is None:
        return config
    steps = max(1, round(seconds * config.rate))
    if tree["controller"].get("horizon") is not None:
        later = [key for key in ("controller.horizon", named) if key in origins]
        if len(later) != 1:
            fail(named, f"controller.horizon and {named} are both given; remove one of them")
        if later != [named]:
            steps = controller.horizon
    if steps > LONGEST_HORIZON:
        fail(
            named,
            f"{named} = {seconds:g} is {steps} steps at rate = {config.rate:g} Hz; at most {LONGEST_HORIZON}",
        )
    settled = msgspec.structs.replace(controller, horizon=steps, horizon_seconds=None)
    return msgspec.structs.replace(config, controller=settled)


def _check_texts(value: Any, fail: Fail, key: str = "") -> None:
    """Check that every text is UTF-8, because it is sent and logged. Only the path of the log may have any bytes."""
    if isinstance(value, dict):
        for name, below in value.items():
            _check_texts(below, fail, f"{key}.{name}".lstrip("."))
    elif isinstance(value, list):
        for i, below in enumerate(value):
            _check_texts(below, fail, f"{key}[{i}]")
    elif isinstance(value, str) and value != (said := strict.readable(value)) and key != "log.path":
        fail(key, f"{key} = '{said}' is not UTF-8, which a configuration must be; choose another name")


def _with_home_folder(config: Config, fail: Fail) -> Config:
    """Replace `~` by the home folder, as a shell would have done."""

    def found(key: str, section: Section) -> Any:
        *_, last = key.split(".")
        path = getattr(section, last)
        user = (path or "").partition("/")
        if not user[0].startswith("~") or (not user[1] and path != "~"):
            return section
        there = os.path.expanduser(path)
        if there.startswith("~"):
            fail(key, f"{key} = {path!r}: no home folder of {user[0]} is known; write the full path")
        return msgspec.structs.replace(section, **{last: there})

    controller = found("controller.sets", found("controller.checkpoint", config.controller))
    bus = msgspec.structs.replace(config.bus, tls=found("bus.tls.keys", config.bus.tls))
    fleet = [found(f"trainer.fleet[{i}].keys", place) for i, place in enumerate(config.trainer.fleet)]
    trainer = msgspec.structs.replace(config.trainer, fleet=fleet)
    log = found("log.path", config.log)
    return msgspec.structs.replace(config, controller=controller, bus=bus, trainer=trainer, log=log)


def _with_absolute_references(config: Config, fail: Fail, places: Mapping[str, Path | None]) -> Config:
    """Make references absolute, so that every process of a run finds the same file from any folder.

    places: base folders by key; "" is the key of all others.
    """

    def found(key: str, reference: str) -> str:
        base = next(folder for name, folder in places.items() if not name or f"{key}.".startswith(f"{name}."))
        if not is_reference(reference) or base is None:
            return reference
        try:
            return absolute(reference, base)
        except ConfigError as error:
            fail(key, f"{key} = {error}")

    plant = msgspec.structs.replace(config.plant, model=found("plant.model", config.plant.model))
    if isinstance(plant.truth, str):
        plant = msgspec.structs.replace(plant, truth=found("plant.truth", plant.truth))
    architecture = found("network.architecture", config.network.architecture)
    network = msgspec.structs.replace(config.network, architecture=architecture)
    return msgspec.structs.replace(config, plant=plant, network=network)


def _with_open_bounds(tree: dict[str, Any]) -> dict[str, Any]:
    """Replace infinite ends of `plant.bounds` by None, because JSON has no infinity. Other keys must be finite."""
    plant = tree.get("plant")
    if not isinstance(plant, dict) or not isinstance(bounds := plant.get("bounds"), dict):
        return tree

    def ends(pair: Any) -> Any:
        if not isinstance(pair, list | tuple) or len(pair) != 2:
            return pair
        return [None if end == infinite else end for end, infinite in zip(pair, INFINITE, strict=True)]

    return {**tree, "plant": {**plant, "bounds": {name: ends(pair) for name, pair in bounds.items()}}}


def _check_architecture(network: NetworkConfig, fail: Fail) -> None:
    """Check a shipped architecture. A user's file is checked by the process that uses it, and need not exist here."""
    if is_reference(network.architecture):
        return
    try:
        known = get_architecture(network.architecture).options
    except ValueError as error:
        fail("network.architecture", f"network.architecture: {error}")
    for key in network.options:
        if key not in known:
            hint = strict.did_you_mean(key, known, f"it has {', '.join(known) or 'none'}")
            option = f"network.options.{key}"
            fail(option, f"{option}: {network.architecture} has no such option; {hint}")


def from_json(text: str) -> Config:
    """Read a configuration from a log, the inverse of `to_json`. Raises `ConfigError`."""
    try:
        tree = msgspec.json.decode(text)
    except (msgspec.DecodeError, RecursionError) as error:
        raise ConfigError(f"the log's configuration is not valid JSON: {error}") from error
    if not isinstance(tree, dict):
        raise ConfigError("the log's configuration is not a table")
    return _checked(tree, "the log's configuration")


def to_json(config: Config) -> str:
    return msgspec.json.encode(_readable(config)).decode()


def to_tree(config: Config) -> dict[str, Any]:
    """Return plain dictionaries and lists in the order of declaration."""
    return msgspec.to_builtins(config)


def to_toml(config: Config) -> str:
    """Return the whole tree as TOML that `load` reads back to an equal `Config`, without keys that are None.

    A `log.path` that is not UTF-8 becomes text that shows its bytes.
    """
    tree = to_tree(_readable(config))
    tree["plant"]["bounds"] = {
        name: [infinite if end is None else end for end, infinite in zip(pair, INFINITE, strict=True)]
        for name, pair in config.plant.bounds.items()
    }
    return tomli_w.dumps(_without_none(tree))


def _readable(config: Config) -> Config:
    path = strict.readable(config.log.path)
    if path == config.log.path:
        return config
    return msgspec.structs.replace(config, log=msgspec.structs.replace(config.log, path=path))


def _without_none(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_none(below) for key, below in value.items() if below is not None}
    return [_without_none(item) for item in value] if isinstance(value, list) else value
