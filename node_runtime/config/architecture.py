"""Loads and registers an architecture that a configuration names in a user's file."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from network_model.operations import Architecture
from network_model.registry import register
from node_runtime.config.reference import is_reference, loaded
from node_runtime.config.sections import Config
from node_runtime.config.strict import ConfigError


class OwnArchitecture(NamedTuple):
    """An architecture from a user's file."""

    name: str
    """Name in descriptions, such as "gru.py:GRU@0f3a...", which ends in the hash of the file's text."""
    architecture: Architecture


def load_architecture(reference: str) -> OwnArchitecture:
    """Load the architecture of a reference such as "gru.py:GRU". Raises `ConfigError` if there is none."""
    found = loaded(reference, lambda value: isinstance(value, Architecture), "architecture")
    place, _, name = reference.rpartition(":")
    return OwnArchitecture(f"{Path(place).name}:{name}@{found.sha256[:16]}", found.value)


def register_architecture(config: Config) -> None:
    """Load and register the architecture of the process's own configuration, never that of a log or a message.

    Raises:
        ConfigError: the configured file does not contain the architecture.
    """
    reference = config.network.architecture
    if not is_reference(reference):
        return
    try:
        own = load_architecture(reference)
    except ConfigError as error:
        raise ConfigError(f"network.architecture: {error}") from error
    register(reference, *own)
