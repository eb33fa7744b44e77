"""Finds architectures by name: each is a file of `network_model/architectures`."""

from __future__ import annotations

import difflib
import functools
import importlib
import pkgutil

from network_model import architectures
from network_model.operations import Architecture


def architecture_names() -> list[str]:
    """Every architecture there is: the files of `network_model/architectures`."""
    return sorted(module.name for module in pkgutil.iter_modules(architectures.__path__))


@functools.cache
def get_architecture(name: str) -> Architecture:
    """The architecture of that name.

    Raises:
        ValueError: there is no such file; the text names the nearest one.
    """
    names = architecture_names()
    if name not in names:
        near = difflib.get_close_matches(name, names, n=1, cutoff=0.0)
        raise ValueError(
            f"no architecture is called {name!r}; did you mean {near[0]!r}? Known: {', '.join(names)}"
        )
    found = importlib.import_module(f"{architectures.__name__}.{name}").ARCHITECTURE
    if not isinstance(found, Architecture):
        raise ValueError(
            f"network_model/architectures/{name}.py: ARCHITECTURE is no network_model.operations.Architecture"
        )
    return found
