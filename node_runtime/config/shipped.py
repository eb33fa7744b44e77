"""The files that come with an installation of Tandem: certified sets, experiments and the commented configuration."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path


def shipped(name: str) -> Path:
    """A file or folder of them, as "sets" or "experiments". It need not exist: an image may leave them out."""
    # They are data of the package `tandem`, which is found here and not imported.
    spec = find_spec("tandem")
    places = spec.submodule_search_locations if spec is not None else None
    return Path(*list(places or [])[:1], "configs", name)
