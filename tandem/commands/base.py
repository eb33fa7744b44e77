"""What every command of `tandem` has, and what every command with a configuration has."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import UseAppendAction, arg

if TYPE_CHECKING:
    from node_runtime.config.sections import Config

FROM_CONFIG = "(default: the configuration's)"


@dataclass(frozen=True, kw_only=True)
class Command:
    """What every command has."""

    json: bool = False
    """Print the result as one JSON object on standard output, and nothing else there."""

    def run(self) -> int:
        """Do it; returns the exit code. Raises `ConfigError` or `Refused` for what cannot be done."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class Configured(Command):
    """A command that reads a configuration."""

    config: Annotated[
        Path | None, arg(metavar="FILE", help_behavior_hint="(default: the shipped values)")
    ] = None
    """Configuration in TOML; see configs/compressor.toml."""
    set: Annotated[UseAppendAction[list[str]], arg(metavar="SECTION.KEY=VALUE")] = field(default_factory=list)
    """Change one value of the configuration."""

    def flags(self) -> dict[str, tuple[str, Any]]:
        """Options that stand for a configuration key: option -> (key, value or None)."""
        return {}

    def resolve(self) -> tuple[Config, dict[str, Any]]:
        """The configuration: file, then --set, then the command's options. And the tree as it was given."""
        from node_runtime.config.sections import from_tree
        from node_runtime.config.strict import ConfigError, apply_override, load_tree

        tree = load_tree(self.config)
        origins = {apply_override(tree, text): f"--set {text}" for text in self.set}
        for option, (key, value) in self.flags().items():
            if value is not None:
                *tables, last = key.split(".")
                table = tree
                for name in tables:
                    table = table.setdefault(name, {})
                    if not isinstance(table, dict):
                        raise ConfigError(
                            f"{self.config}: {name} is a table: write [{name}] and its keys below"
                        )
                table[last] = value
                origins[key] = option
        return from_tree(tree, str(self.config or "configuration"), origins), tree
