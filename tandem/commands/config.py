"""`tandem config`: the resolved configuration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from tyro.conf import Suppress, subcommand

from tandem import terminal
from tandem.commands.base import Configured


@dataclass(frozen=True, kw_only=True)
class ConfigShow(Configured):
    """Print the resolved configuration: file, then --set, then the plant's own values and defaults."""

    def run(self) -> int:
        from node_runtime.config.loading import to_toml, to_tree
        from node_runtime.config.plant import spelt_out

        config = spelt_out(*self.resolve_with_plant())

        if self.json:
            terminal.emit(to_tree(config))
        else:
            terminal.write(to_toml(config))
        return 0


@dataclass(frozen=True, kw_only=True)
class ConfigCommand:
    """Work with the configuration."""

    # A union, so that `show` is a word of its own on the command line.
    action: Annotated[ConfigShow, subcommand("show")] | Annotated[None, Suppress]
