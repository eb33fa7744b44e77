"""The architecture that a configuration names in a file of its own, made known to this process."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from network_model.operations import Architecture
from network_model.registry import register
from node_runtime.config.reference import is_reference, loaded
from node_runtime.config.sections import Config
from node_runtime.config.strict import ConfigError


class OwnArchitecture(NamedTuple):
    """Of a stranger's file."""

    name: str
    """What descriptions call it, "gru.py:GRU@0f3a...": it ends in the hash of the file's text."""
    architecture: Architecture


def load_architecture(reference: str) -> OwnArchitecture:
    """What "gru.py:GRU" names. Raises `ConfigError`: nothing there, or no architecture."""
    found = loaded(reference, lambda value: isinstance(value, Architecture), "architecture")
    place, _, name = reference.rpartition(":")
    return OwnArchitecture(f"{Path(place).name}:{name}@{found.sha256[:16]}", found.value)


def register_architecture(config: Config) -> None:
    """For who uses the network of a configuration of its own; never for one that came in a log or a message.

    Raises:
        ConfigError: it names a file in which there is no such architecture.
    """
    reference = config.network.architecture
    if not is_reference(reference):
        return
    try:
        own = load_architecture(reference)
    except ConfigError as error:
        raise ConfigError(f"network.architecture: {error}") from error
    register(reference, *own)
