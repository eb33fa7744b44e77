"""`tandem run`: the files, the screen and the figures around a `Supervisor`."""

from __future__ import annotations

import os
import socket
from pathlib import Path
from typing import Any

import msgspec
from rich.console import Console
from rich.status import Status

from controller_node.build import build_model
from controller_node.guarantee import guarantee
from node_runtime.config.sections import Config, to_toml
from node_runtime.realtime.scheduling import READER_PRIORITY, GarbageCollection, punctual
from run_log.errors import LogError
from run_log.reading.reader import read_run
from run_log.reporting import report
from run_log.reporting.summary import summarise
from run_log.writing.parts import existing_parts
from tandem import summary_table, terminal
from tandem.checks import plant_of
from tandem.live.files import RunFiles, claimed
from tandem.live.monitor import Monitor, Snapshot
from tandem.live.screen import Screen
from tandem.live.supervisor import Impatient, StartError, Supervisor, Wish, wishes

INTERRUPTED = 130


def run(config: Config, seconds: float, endpoint_given: bool, as_json: bool, trainer: bool = True) -> int:
    """Run everything for `seconds` from the first command; returns the exit code.

    trainer: False: it runs elsewhere.

    Raises:
        Refused: there is nothing to run, or no place for the log.
        ConfigError: the configuration does not fit the plant.
    """
    if not seconds > config.period:
        raise terminal.Refused(f"--seconds {seconds:g}: less than one period of {config.period:g} s")
    plant = plant_of(config)
    console = terminal.console(as_json)
    said = guarantee(config, build_model(config))
    with claimed(Path(config.log.path)) as (files, moved), wishes() as wish:
        for text in moved:
            console.print(text, style="dim", markup=False, soft_wrap=True)
        console.print(said, markup=False, soft_wrap=True)
        bus = config.bus if endpoint_given else msgspec.structs.replace(config.bus, endpoint=_free_endpoint())
        log = msgspec.structs.replace(config.log, path=str(files.log.absolute()))
        # A run is a new experiment: it begins with what the configuration says and nothing else.
        controller = msgspec.structs.replace(config.controller, checkpoint="")
        resolved = msgspec.structs.replace(config, bus=bus, log=log, controller=controller)
        files.config.write_text(to_toml(resolved), encoding="utf-8")
        monitor = Monitor(resolved, plant, seconds)
        try:
            trouble, logged = _supervise(resolved, files, monitor, wish, console, trainer)
        except StartError as error:
            terminal.complain(f"{error}\nAll output is in {files.folder}.", as_json)
            return 2 if error.exit_code == 2 else 1
        except Impatient:
            text = f"ended at once, everything was killed; {files.log} may be cut short"
            terminal.complain(f"{text}: `tandem recover {files.log}` makes it whole", as_json)
            return INTERRUPTED
        return _conclude(files, console, trouble, logged, monitor.first_command is not None, as_json)


def _supervise(
    config: Config, files: RunFiles, monitor: Monitor, wish: Wish, console: Console, trainer: bool
) -> tuple[str | None, bool]:
    """Why the run ended badly, or None; and whether its log is whole."""
    priority = min(READER_PRIORITY, config.realtime.priority)
    with Screen(console, monitor.new_events) as screen, punctual(priority, silent=True):
        garbage = GarbageCollection()
        garbage.begin()

        def show(now: Snapshot) -> None:
            screen.show(now)
            garbage.idle()

        supervisor = Supervisor(config, files.config, files.folder, monitor, wish, show, trainer)
        trouble = supervisor.run()
        return trouble, not supervisor.recorder_died


def _conclude(
    files: RunFiles, console: Console, trouble: str | None, logged: bool, began: bool, as_json: bool
) -> int:
    """Figures and picture from the log alone."""
    if trouble is None and not logged:
        trouble = f"the recorder did not end well, and {files.log} lacks what came after; see {files.folder}"
    if trouble is None and not began:
        trouble = "stopped before the first command"
    result: dict[str, Any] = {}
    try:
        with Status("reading the log and drawing", console=console):
            parts = existing_parts(files.log)
            ran = read_run(parts[0] if parts else files.log)
            summary = summarise(ran)
            picture = report.picture(ran, files.picture)
    except LogError as error:
        trouble = f"{trouble}\n{error}" if trouble else str(error)
    else:
        result = summary_table.of(summary)
        console.print(summary_table.table(summary))
        console.print(f"picture {_near(picture)}", markup=False, soft_wrap=True)
        for part in parts:
            console.print(f"replay  tandem replay {_near(part)}", markup=False, soft_wrap=True)
        if len(parts) > 1:
            text = f"the log has {len(parts)} parts; table and picture are of the first, {_near(parts[0])}"
            console.print(text, style="yellow", markup=False, soft_wrap=True)
        elif ran.note:
            console.print(ran.note, style="yellow", markup=False, soft_wrap=True)
    if trouble is not None:
        terminal.complain(f"{trouble}\nAll output is in {_near(files.folder)}.", as_json=False)
        result = {"error": trouble, **result}
    if as_json:
        terminal.emit(result)
    return 0 if trouble is None else 1


def _free_endpoint() -> str:
    """A loopback port that nobody listens on at this moment."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def _near(path: Path) -> str:
    """As short as it can be said from here."""
    near = os.path.relpath(path)
    return near if not near.startswith("..") else str(path)
