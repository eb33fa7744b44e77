"""`tandem run`: the files, the screen and the figures around a `Supervisor`."""

from __future__ import annotations

import math
import os
from contextlib import suppress
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import arg

from node_runtime.config.literals import OracleName
from node_runtime.config.strict import readable
from node_runtime.printable import printable
from tandem import terminal
from tandem.commands.base import FROM_CONFIG, INTERRUPTED, Configured, require

if TYPE_CHECKING:
    from node_runtime.config.sections import Config
    from tandem.live.files import RunFiles
    from tandem.live.monitor import Monitor
    from tandem.live.snapshot import Snapshot
    from tandem.live.supervisor import Wish

USUAL_S, LONGEST_S = 20.0, 1e8
"""In seconds: three years."""


@dataclass(frozen=True, kw_only=True)
class Run(Configured):
    """Run router, recorder, trainer, plant and controller here, show them live, and leave a log and a picture."""

    EXTRAS = "trainer,log"
    KEYS = (
        *(("oracle", "controller.oracle"), ("rate", "rate"), ("seed", "seed")),
        *(("noise", "plant.sensors.noise"), ("log", "log.path")),
    )

    seconds: Annotated[
        float | None, arg(metavar="S", help_behavior_hint="(default: 20; with --no-plant until Ctrl-C)")
    ] = None
    """Seconds, counted from the first command."""
    oracle: Annotated[
        OracleName | None, arg(metavar="linear|constant|l2nw|dnn|perfect", help_behavior_hint=FROM_CONFIG)
    ] = None
    """Estimate of h."""
    rate: Annotated[float | None, arg(metavar="HZ", help_behavior_hint=FROM_CONFIG)] = None
    """Samples a second."""
    seed: Annotated[int | None, arg(metavar="INT", help_behavior_hint=FROM_CONFIG)] = None
    """Seed of everything random."""
    noise: Annotated[float | None, arg(metavar="SHARE", help_behavior_hint=FROM_CONFIG)] = None
    """Measurement noise of every state: its standard deviation as a share of the half-width, for example 0.01."""
    log: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="(default: run.mcap)")] = None
    """The log; an existing file of that name is moved aside. The picture is placed beside it."""
    live: bool = False
    """Show the run in a browser too, at http://localhost:8765 (live.port): a page of its own, and a socket for Foxglove
    and Lichtblick."""
    no_trainer: bool = False
    """Start no trainer here: it runs on another machine ("Put the trainer on another machine" in the
    documentation), or there is none."""
    no_plant: bool = False
    """Start no plant here, and wait for one: `tandem plant`, or the gateway of a machine ("The wire" in the
    documentation). The router is then at the configuration's endpoint."""

    def run(self) -> int:
        """Run everything for `seconds` from the first command."""
        config, given = self.resolve()
        seconds = self._seconds(config.period)
        path = Path(config.log.path).absolute()
        # A file name may be any bytes, but control characters would affect the terminal that lists the folder.
        shown = readable(str(path))
        if printable(shown) != shown:
            raise terminal.Refused(f"{path}: control characters in the name of the log or of its folders")
        import msgspec

        from controller_node.build import build_model, build_plant
        from controller_node.guarantee import guarantee
        from node_runtime.config.architecture import register_architecture
        from node_runtime.config.loading import to_toml
        from tandem.live.files import claimed
        from tandem.live.monitor import Monitor
        from tandem.live.supervisor import Impatient, StartError, trains, wishes

        live = self._live(config)
        require("zstandard", "matplotlib", *(["torch"] if trains(config) and not self.no_trainer else []))
        register_architecture(config)
        plant = build_plant(config)
        said = guarantee(config, build_model(config))
        with claimed(Path(config.log.path)) as (files, moved), wishes() as wish:
            self.say(*moved, style="dim")
            self.say(said)
            known = self.no_plant or "endpoint" in given.get("bus", {})
            endpoint = config.bus.endpoint if known else _free_endpoint()
            bus = msgspec.structs.replace(config.bus, endpoint=endpoint)
            log = msgspec.structs.replace(config.log, path=str(files.log.absolute()))
            # A run is a new experiment: it begins with the configuration and no memory.
            controller = msgspec.structs.replace(config.controller, checkpoint="")
            resolved = msgspec.structs.replace(config, bus=bus, log=log, controller=controller)
            files.config.write_text(to_toml(resolved), encoding="utf-8")
            monitor = Monitor(resolved, plant, seconds)
            try:
                trouble, logged = self._supervise(resolved, files, monitor, wish, live)
            except StartError as error:
                terminal.complain(f"{error}\nAll output is in {files.folder}.", self.json)
                return 2 if error.exit_code == 2 else 1
            except Impatient:
                text = f"ended at once and killed all processes; {files.log} may be incomplete"
                terminal.complain(f"{text}: `tandem recover {files.log}` repairs it", self.json)
                return INTERRUPTED
            try:
                return self._conclude(resolved, files, trouble, logged, monitor.first_command is not None)
            except Impatient:
                text = f"interrupted; `tandem report {files.log}` gives figures and pictures"
                terminal.complain(text, self.json)
                return INTERRUPTED

    def _seconds(self, period: float) -> float:
        """Return the duration in seconds; infinity if only the person ends it. Raises `Refused`."""
        if self.seconds is None:
            return math.inf if self.no_plant else USUAL_S
        if not self.seconds > period:
            raise terminal.Refused(f"--seconds {self.seconds:g}: less than one period of {period:g} s")
        terminal.limited("--seconds", self.seconds, 0.0, LONGEST_S)
        return self.seconds

    def _live(self, config: Config) -> bool:
        """Return whether to serve the run to browsers, and print where, or why not.

        Raises:
            Refused: a package is missing.
        """
        if not self.live:
            return False
        if find_spec("websockets") is None:
            raise terminal.Refused("--live needs websockets: pip install 'tandem-control[live]'")
        from tandem.web.address import address, is_free, taken

        if not is_free(config):
            self.say(f"no live view: {taken(config)}", style="yellow")
            return False
        self.say(f"live     http://{address(config)}, for Foxglove and Lichtblick ws://{address(config)}")
        return True

    def _elsewhere(self) -> list[str]:
        """Names of the processes that are not started here."""
        absent = {"plant": self.no_plant, "trainer": self.no_trainer}
        return [name for name, is_absent in absent.items() if is_absent]

    def _supervise(
        self, config: Config, files: RunFiles, monitor: Monitor, wish: Wish, live: bool
    ) -> tuple[str | None, bool]:
        """Return why the run failed, or None; and whether its log is complete."""
        from node_runtime.realtime.scheduling import READER_PRIORITY, GarbageCollection, punctual
        from tandem.live.screen import Screen
        from tandem.live.supervisor import Supervisor

        priority = min(READER_PRIORITY, config.realtime.priority)
        with Screen(self.console, monitor.new_events) as screen, punctual(priority, silent=True):
            garbage = GarbageCollection()
            garbage.begin()

            def show(now: Snapshot) -> None:
                screen.show(now)
                garbage.idle()

            supervisor = Supervisor(
                config, files.config, files.folder, monitor, wish, show, self._elsewhere(), live
            )
            trouble = supervisor.run()
            return trouble, not supervisor.recorder_died

    def _conclude(
        self, config: Config, files: RunFiles, trouble: str | None, logged: bool, began: bool
    ) -> int:
        """Return figures and picture from the log, with the equations that `config` names if they moved here.

        Raises:
            Impatient: the figures are not waited for.
        """
        from lbmpc.plants import get_plant, get_truth
        from node_runtime.config.plant import true_plant_of
        from node_runtime.config.strict import ConfigError
        from run_log.errors import LogError
        from run_log.reading.reader import read_run
        from run_log.reporting import report
        from run_log.reporting.canvas import PictureError
        from run_log.reporting.summary import summarise
        from run_log.writing.parts import existing_parts
        from tandem import summary_table
        from tandem.live.supervisor import Impatient

        if trouble is None and not began:
            trouble = "stopped before the first command" + (": no plant connected" if self.no_plant else "")
        if trouble is None and not logged:
            trouble = f"the recorder ended early, and the end of the run is missing in {files.log}; see {files.folder}"
        parts = existing_parts(files.log)
        if not parts and not began:
            # It was stopped while the processes started, and the recorder had not begun a log.
            terminal.complain(
                f"{trouble}; there is no log. All output is in {_near(files.folder)}.", as_json=False
            )
            self.emit({"error": trouble})
            return 1
        result: dict[str, Any] = {}
        code = 1
        try:
            with self.console.status("reading the log"):
                ran = read_run(parts[0] if parts else files.log)
                # A file may have changed since; then the motion between samples is left out.
                with suppress(ConfigError):
                    # The motion of a machine between samples is not known.
                    ran.truth = None if self.no_plant else true_plant_of(config, get_plant, get_truth)
                summary = summarise(ran)
            result = summary_table.of(summary)
            self.console.print(summary_table.table(summary))
            try:
                with self.console.status("drawing"):
                    self.say(f"picture {_near(report.picture(ran, files.picture))}")
            except PictureError as error:
                self.say(f"no picture: {error}", style="yellow")
            except Impatient:
                interrupted = f"interrupted while drawing; `tandem report {files.log}` draws it"
                trouble = f"{trouble}\n{interrupted}" if trouble else interrupted
                code = INTERRUPTED
        except LogError as error:
            trouble = f"{trouble}\n{error}" if trouble else str(error)
        else:
            self.say(*(f"replay  tandem replay {_near(part)}" for part in parts))
            if len(parts) > 1:
                text = (
                    f"the log has {len(parts)} parts; table and picture are of the first, {_near(parts[0])}"
                )
                self.say(text, style="yellow")
            elif ran.note:
                self.say(ran.note, style="yellow")
        if trouble is not None:
            terminal.complain(f"{trouble}\nAll output is in {_near(files.folder)}.", as_json=False)
            result = {"error": trouble, **result}
        self.emit(result)
        return 0 if trouble is None else code


def _free_endpoint() -> str:
    """Return a free loopback port."""
    import socket

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def _near(path: Path) -> str:
    """Return the shortest form of the path from the present folder."""
    near = os.path.relpath(path)
    return near if not near.startswith("..") else str(path)
