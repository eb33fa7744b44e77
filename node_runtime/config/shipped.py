"""Files that are installed with Tandem: certified sets, experiments and configurations."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

from node_runtime.config.strict import ConfigError, did_you_mean


def shipped(name: str) -> Path:
    """Return the path of a shipped file or folder, such as "sets". It may not exist, because an image can omit it."""
    # The files belong to the package `tandem`, which is located without an import.
    spec = find_spec("tandem")
    places = spec.submodule_search_locations if spec is not None else None
    return Path(*list(places or [])[:1], "configs", name)


def config_file(given: str | Path) -> Path:
    """Return the path of a file, or of the shipped configuration of that name if there is no such file.

    Raises:
        ConfigError: a plain name, without folder and suffix, is neither.
    """
    path = Path(given)
    if path.suffix or path != Path(path.name) or path.is_file():
        return path
    known = {file.stem: file for file in sorted(shipped("").glob("*.toml"))}
    if path.name not in known:
        hint = did_you_mean(path.name, known, f"there are {', '.join(known) or 'none'}")
        raise ConfigError(f"{path}: no such file, and no shipped configuration of that name; {hint}")
    return known[path.name]
