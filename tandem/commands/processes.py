"""`tandem router`, `controller`, `trainer`, `plant` and `record`: one process each, until it is told to stop."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import arg

from node_runtime.printable import printable
from tandem.commands.base import FROM_CONFIG, Configured, require

if TYPE_CHECKING:
    from node_runtime.config.sections import Config


class PrintableLog(logging.Formatter):
    """Text of other processes in names and messages stays text, and within its lines."""

    def format(self, record: logging.LogRecord) -> str:
        return printable(super().format(record)).replace("\n", "\n    ")


class Process(Configured):
    """A command that is one process."""

    def _process(self, name: str, main: Callable[[Config], int], config: Config) -> int:
        """Run it; its log goes to standard error."""
        handler = logging.StreamHandler(sys.stderr)
        form = f"%(asctime)s.%(msecs)03d {name} %(levelname)s: %(message)s"
        handler.setFormatter(PrintableLog(form, datefmt="%H:%M:%S"))
        logging.basicConfig(handlers=[handler], level=logging.INFO)
        code = main(config)
        self.emit({"process": name, "exit_code": code})
        return code


@dataclass(frozen=True, kw_only=True)
class Router(Process):
    """The Zenoh router; all processes are its clients."""

    def run(self) -> int:
        config, _ = self.resolve()
        from node_runtime.router import main

        return self._process("router", main, config)


@dataclass(frozen=True, kw_only=True)
class Controller(Process):
    """The controller: in each period it latches a tick, solves, and sends a command."""

    def run(self) -> int:
        config, _ = self.resolve_with_plant()
        from controller_node.node import main

        return self._process("controller", main, config)


@dataclass(frozen=True, kw_only=True)
class Trainer(Process):
    """The trainer: collects samples, trains the hidden layers, and sends them. Needs torch, not CasADi."""

    EXTRAS = "trainer"

    plants: str | None = None
    """Train for all plants whose names match, e.g. 'jet*'; default: the one named in the configuration."""

    def run(self) -> int:
        config, _ = self.resolve()
        from trainer_node.main import main

        return self._process("trainer", lambda config: main(config, plants=self.plants), config)


@dataclass(frozen=True, kw_only=True)
class Plant(Process):
    """The simulated plant: integrates the true motion in real time and applies commands as they arrive."""

    def run(self) -> int:
        config, _ = self.resolve_with_plant()
        from plant_sim.node import main

        return self._process("plant", main, config)


@dataclass(frozen=True, kw_only=True)
class Record(Process):
    """The recorder: writes all messages on the bus to a log."""

    EXTRAS = "log"
    KEYS = (("log", "log.path"),)

    log: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint=FROM_CONFIG)] = None
    """The log; must not exist yet."""

    def run(self) -> int:
        config, _ = self.resolve_with_plant()
        from run_log.writing.recorder import main

        require("zstandard")

        return self._process("recorder", main, config)
