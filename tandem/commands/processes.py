"""`tandem router`, `controller`, `trainer`, `plant` and `record`: one process each, until it is told to stop."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import arg

from tandem import terminal
from tandem.commands.base import FROM_CONFIG, Configured

if TYPE_CHECKING:
    from node_runtime.config.sections import Config


@dataclass(frozen=True, kw_only=True)
class Router(Configured):
    """The Zenoh router that all processes are clients of."""

    def run(self) -> int:
        config, _ = self.resolve()
        from node_runtime.router import main

        return _process("router", main, config, self.json)


@dataclass(frozen=True, kw_only=True)
class Controller(Configured):
    """The controller: one tick a period, latch, solve, command."""

    def run(self) -> int:
        config, _ = self.resolve_with_plant()
        from controller_node.node import main

        return _process("controller", main, config, self.json)


@dataclass(frozen=True, kw_only=True)
class Trainer(Configured):
    """The trainer: collects samples, trains the hidden layers, sends them. Needs torch, not CasADi."""

    EXTRAS = "trainer"

    plants: str | None = None
    """Train for all plants whose names match, e.g. 'jet*'; by default the one named in the configuration."""

    def run(self) -> int:
        config, _ = self.resolve()
        from trainer_node.main import main

        return _process("trainer", lambda config: main(config, plants=self.plants), config, self.json)


@dataclass(frozen=True, kw_only=True)
class Plant(Configured):
    """The plant: integrates the truth in real time, applies commands as they arrive."""

    def run(self) -> int:
        config, _ = self.resolve_with_plant()
        from plant_sim.node import main

        return _process("plant", main, config, self.json)


@dataclass(frozen=True, kw_only=True)
class Record(Configured):
    """The recorder: writes everything on the bus to a log."""

    EXTRAS = "log"

    log: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint=FROM_CONFIG)] = None
    """The log; must not exist yet."""

    def flags(self) -> dict[str, tuple[str, Any]]:
        return {"--log": ("log.path", None if self.log is None else str(self.log))}

    def run(self) -> int:
        config, _ = self.resolve_with_plant()
        from run_log.writing.recorder import main

        return _process("recorder", main, config, self.json)


def _process(name: str, main: Callable[[Config], int], config: Config, as_json: bool) -> int:
    """Run one process; its log goes to standard error."""
    import logging

    logging.basicConfig(
        stream=sys.stderr,
        level=logging.INFO,
        format=f"%(asctime)s.%(msecs)03d {name} %(levelname)s: %(message)s",
        datefmt="%H:%M:%S",
    )
    code = main(config)
    if as_json:
        terminal.emit({"process": name, "exit_code": code})
    return code
