"""`tandem router`, `controller`, `trainer`, `plant`, `record`, `live`: one process each, until it is told to stop."""

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
from tandem.terminal import Refused

if TYPE_CHECKING:
    from lbmpc.plants import Description
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

    plants: Annotated[
        str | None, arg(metavar="PATTERN", help_behavior_hint="(default: the one named in the configuration)")
    ] = None
    """Train for all plants whose names match, for example 'jet*'."""

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


@dataclass(frozen=True, kw_only=True)
class Live(Process):
    """Show a running system in a browser: a page at http://localhost:8765, and a socket for Foxglove and Lichtblick."""

    EXTRAS = "live"
    KEYS = (("port", "live.port"),)

    port: Annotated[int | None, arg(metavar="PORT", help_behavior_hint=FROM_CONFIG)] = None
    """Port of the page, on this machine only."""
    layout: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="(default: none)")] = None
    """Write the layout for Foxglove and Lichtblick to this file, and end."""

    def run(self) -> int:
        config, plant = self.resolve_with_plant()
        if self.layout is not None:
            return self._write_layout(plant, self.layout)
        from tandem.web.main import main

        return self._process("live", main, config)

    def _write_layout(self, plant: Description, path: Path) -> int:
        import msgspec

        from node_runtime.whole_file import write_whole
        from tandem.web.layout import layout

        try:
            write_whole(path, msgspec.json.format(msgspec.json.encode(layout(plant))))
        except OSError as error:
            raise Refused(f"{path}: cannot be written: {error.strerror}") from error
        self.say(f"layout for Foxglove and Lichtblick in {path}")
        self.emit({"layout": str(path)})
        return 0
