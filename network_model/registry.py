"""Finds architectures by name: the files of `network_model/architectures`, and those that this process was given.

An architecture of a stranger's file has a name that ends in the hash of the file's text, as "gru.py:GRU@0f3a...": so a
name means the same function in every process, on every machine. Nothing is ever loaded because a message or a log
names it: whoever reads a configuration loads what it names and registers it here.
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
    """Every architecture that is part of Tandem: the files of `network_model/architectures`."""
    return sorted(module.name for module in pkgutil.iter_modules(architectures.__path__))


def register(reference: str, name: str, architecture: Architecture) -> None:
    """Make an architecture known to this process.

    Args:
        reference: how a configuration names it, "/home/me/gru.py:GRU".
        name: how a description names it, "gru.py:GRU@0f3a...", with the hash of the file's text.
        architecture: what acts.
    """
    _given[name], _names[reference] = architecture, name


def name_of(reference: str) -> str:
    """What a description calls the architecture that a configuration names; that itself where nobody registered it."""
    return _names.get(reference, reference)


def get_architecture(name: str) -> Architecture:
    """The architecture that a description calls so.

    Raises:
        ValueError: there is none; the text names the nearest one, or says that the file's text is another.
    """
    if name in _given:
        return _given[name]
    if ":" not in name:
        return _shipped(name)
    file, _, _text = name.partition("@")
    others = ", ".join(known for known in _given if known.partition("@")[0] == file)
    if others:
        raise ValueError(f"the network is {name}, and this process has {others}: the file's text is another")
    raise ValueError(
        f"the network is {name}, a file that this process was not given: network.architecture of its own "
        "configuration has to name it"
    )


@functools.cache
def _shipped(name: str) -> Architecture:
    names = architecture_names()
    if name not in names:
        near = difflib.get_close_matches(name, names, n=1, cutoff=0.0)
        raise ValueError(
            f"no architecture is called {name!r}; did you mean {near[0]!r}? Known: {', '.join(names)}; or a file "
            "of your own, as 'gru.py:GRU'"
        )
    return importlib.import_module(f"{architectures.__name__}.{name}").ARCHITECTURE
