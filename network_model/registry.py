"""Finds architectures by name: the files of `network_model/architectures`, and those registered in this process.

The name of an architecture from a user's file ends in the hash of the file's text, as in "gru.py:GRU@0f3a...". A name
therefore means the same function in every process, on every machine. A message or a log never causes a file to be
loaded: the process that reads a configuration loads the file named in it and registers the architecture here.
"""

from __future__ import annotations

import difflib
import functools
import importlib
import pkgutil

from network_model import architectures
from network_model.operations import Architecture

_given: dict[str, Architecture] = {}
_names: dict[str, str] = {}


def architecture_names() -> list[str]:
    """Return the names of the architectures that are part of Tandem: the files of `network_model/architectures`."""
    return sorted(module.name for module in pkgutil.iter_modules(architectures.__path__))


def register(reference: str, name: str, architecture: Architecture) -> None:
    """Make an architecture known to this process.

    Args:
        reference: the name in a configuration, such as "/home/me/gru.py:GRU".
        name: the name in a description, such as "gru.py:GRU@0f3a...", with the hash of the file's text.
        architecture: the architecture itself.
    """
    _given[name], _names[reference] = architecture, name


def name_of(reference: str) -> str:
    """Return the description's name for a configured architecture; the reference itself if it is not registered."""
    return _names.get(reference, reference)


def get_architecture(name: str) -> Architecture:
    """Return the architecture with this name in descriptions.

    Raises:
        ValueError: there is none. The text gives the nearest name, or says that the file's text differs.
    """
    if name in _given:
        return _given[name]
    if ":" not in name:
        return _shipped(name)
    file, _, _text = name.partition("@")
    others = ", ".join(known for known in _given if known.partition("@")[0] == file)
    if others:
        raise ValueError(
            f"the network is {name}, but this process has {others}: the texts of the files differ"
        )
    raise ValueError(
        f"the network is {name}, a file that this process did not load; name the file in network.architecture of "
        "this process's configuration"
    )


@functools.cache
def _shipped(name: str) -> Architecture:
    names = architecture_names()
    if name not in names:
        near = difflib.get_close_matches(name, names, n=1, cutoff=0.0)
        raise ValueError(
            f"no architecture is called {name!r}; did you mean {near[0]!r}? Known: {', '.join(names)}; or a file "
            "of your own, such as 'gru.py:GRU'"
        )
    return importlib.import_module(f"{architectures.__name__}.{name}").ARCHITECTURE
