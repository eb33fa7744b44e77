"""Base classes of the commands of `tandem`, and of those with a configuration.

A command's file holds its arguments and its work. Imports are inside the functions that need them: `tandem
--help` loads all commands, and each process loads only what it needs.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from tyro.conf import UseAppendAction, arg

from tandem import terminal

if TYPE_CHECKING:
    from rich.console import Console

    from lbmpc.plants import Description
    from node_runtime.config.sections import Config

FROM_CONFIG = "(default: the configuration's)"
OPTIONAL_PACKAGES = (
    "torch",
    "mcap",
    "msgpack",
    "zstandard",
    "matplotlib",
    "jinja2",
    "pyarrow",
    "rerun",
    "websockets",
    "distributed",
)
"""Packages of the extras. If one is missing, the command ends with a message."""
NO_SETS, INTERRUPTED = 3, 130
"""Exit codes."""


@dataclass(frozen=True, kw_only=True)
class Command:
    """Base class of every command."""

    EXTRAS: ClassVar[str] = ""
    """Extras that it needs, as in pip install 'tandem-control[EXTRAS]'."""

    json: bool = False
    """Print the result as one JSON object on standard output, and nothing else there."""

    def run(self) -> int:
        """Run; return the exit code. Raises `ConfigError`, `LogError` or `Refused` if the request cannot be done."""
        raise NotImplementedError

    @cached_property
    def console(self) -> Console:
        """Output for a person."""
        return terminal.console(self.json)

    def say(self, *lines: str, style: str | None = None) -> None:
        """Print lines for a person, unchanged."""
        terminal.say(self.console, *lines, style=style)

    def emit(self, result: Mapping[str, Any]) -> None:
        """Print the result as one JSON object, if `--json` is given."""
        if self.json:
            terminal.emit(result)


@dataclass(frozen=True, kw_only=True)
class Configured(Command):
    """A command that reads a configuration."""

    KEYS: ClassVar[tuple[tuple[str, str], ...]] = ()
    """(option, key of the configuration). An option of None changes nothing."""

    config: Annotated[Path | None, arg(metavar="NAME|FILE", help_behavior_hint="(default: compressor)")] = (
        None
    )
    """A shipped configuration (compressor, compressor-cheap, published), or your own TOML file. A file of that name has
    precedence. `tandem config show` prints all keys."""
    set: Annotated[UseAppendAction[list[str]], arg(metavar="SECTION.KEY=VALUE")] = field(default_factory=list)
    """Change one value of the configuration."""

    def resolve(self) -> tuple[Config, dict[str, Any]]:
        """Return the configuration (file, then --set, then the command's options) and the tree as it was given."""
        from node_runtime.config.loading import from_tree
        from node_runtime.config.shipped import config_file
        from node_runtime.config.strict import ConfigError, apply_override, load_tree

        file = None if self.config is None else config_file(self.config)
        tree = {} if file is None else load_tree(file)
        origins = {apply_override(tree, text): f"--set {text}" for text in self.set}
        for option, key in self.KEYS:
            value = getattr(self, option)
            if value is None:
                continue
            *tables, last = key.split(".")
            table = tree
            for name in tables:
                table = table.setdefault(name, {})
                if not isinstance(table, dict):
                    raise ConfigError(f"{self.config}: {name} is a table: write [{name}] and its keys below")
            table[last] = str(value) if isinstance(value, Path) else value
            origins[key] = f"--{option}"
        folder = None if file is None else file.parent
        return from_tree(tree, str(self.config or "configuration"), origins, folder), tree

    def resolve_with_plant(self) -> tuple[Config, Description]:
        """Return the configuration and its plant, which fit each other."""
        from lbmpc.plants import get_plant
        from node_runtime.config.plant import plant_of

        config, _ = self.resolve()
        return config, plant_of(config, get_plant)


def require(*packages: str) -> None:
    """Raise `ModuleNotFoundError` for a package that would be missed late, or in another process only."""
    for package in packages:
        if find_spec(package) is None:
            raise ModuleNotFoundError(f"No module named {package!r}", name=package)
