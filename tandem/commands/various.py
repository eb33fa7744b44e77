"""What the commands do, apart from `tandem run`. Each imports what it needs when it is called."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from node_runtime.config.sections import Config, to_toml, to_tree
from tandem import terminal
from tandem.terminal import Refused

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress

Main = Callable[[Config], int]


# -- one process each ----------------------------------------------------


def router(config: Config, as_json: bool) -> int:
    from node_runtime.router import main

    return _node("router", main, config, as_json)


def controller(config: Config, as_json: bool) -> int:
    from controller_node.node import main
    from tandem.checks import plant_of

    plant_of(config)
    return _node("controller", main, config, as_json)


def trainer(config: Config, plants: str | None, as_json: bool) -> int:
    try:
        from trainer_node.main import main
    except ModuleNotFoundError as error:
        if error.name != "torch":
            raise
        raise Refused("the trainer needs torch: pip install 'tandem-control[trainer]'") from error
    return _node("trainer", lambda config: main(config, plants=plants), config, as_json)


def plant(config: Config, as_json: bool) -> int:
    from plant_sim.node import main
    from tandem.checks import plant_of

    plant_of(config)
    return _node("plant", main, config, as_json)


def record(config: Config, as_json: bool) -> int:
    with log_packages():
        from run_log.writing.recorder import main
    from tandem.checks import plant_of

    plant_of(config)
    return _node("recorder", main, config, as_json)


def _node(name: str, main: Main, config: Config, as_json: bool) -> int:
    """Run one process until it is told to stop; its log goes to standard error."""
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


# -- simulation and logs ----------------------------------------------------


def simulate(config: Config, steps: int, adapt_only: bool, log: Path | None, as_json: bool) -> int:
    """Lock-step simulation, with a progress bar; then figures, and the log where one is wanted."""
    if steps < 1:
        raise Refused(f"--steps {steps}: at least 1")
    if log is not None and log.exists():
        raise Refused(f"{log}: exists already, and a log never overwrites anything; choose another name")
    from controller_node.build import build_model
    from controller_node.guarantee import guarantee
    from lbmpc.plants import PlantError
    from run_log.errors import LogError
    from run_log.reporting.summary import summarise
    from tandem import summary_table
    from tandem.checks import plant_of
    from tandem.experiments.simulation.lockstep import simulate as lock_step

    plant_of(config)
    console = terminal.console(as_json)
    console.print(guarantee(config, build_model(config)), markup=False, soft_wrap=True)
    with progress_bar(console) as bar:
        task = bar.add_task(f"simulating, {config.controller.oracle}", total=steps)
        try:
            ran = lock_step(
                config, steps, adapt_only=adapt_only, progress=lambda step: bar.update(task, completed=step)
            )
        except PlantError as error:
            terminal.complain(f"the plant was lost: {error}", as_json)
            return 1
    if log is not None:
        from run_log.writing.save import save

        try:
            save(ran, log)
        except LogError as error:
            raise Refused(str(error)) from error
        ran.path = log
    summary = summarise(ran)
    console.print(summary_table.table(summary))
    if as_json:
        terminal.emit(summary_table.of(summary))
    return 0


def replay(file: Path, from_tick: int | None, assignments: list[str], as_json: bool) -> int:
    """0 when every command and keyframe is equal to the byte; 1 when one differs, if only by rounding, or is lost."""
    with log_packages():
        from run_log.errors import LogError
        from run_log.reading.reader import read_run
        from run_log.replaying.replay import ROUNDING
        from run_log.replaying.replay import replay as replay_run

    console = terminal.console(as_json)
    try:
        ran = read_run(file)
        with progress_bar(console) as bar:
            task = bar.add_task("replaying", total=None)
            found = replay_run(
                ran, from_tick, assignments, lambda done, total: bar.update(task, completed=done, total=total)
            )
    except LogError as error:
        raise Refused(str(error)) from error
    if found.equal:
        text = f"{found.ticks} of {found.ticks} ticks equal, byte for byte, and {found.keyframes} keyframes"
        console.print(text, style="yellow" if found.lost_ticks else "green", markup=False, soft_wrap=True)
    elif found.rounding and found.elsewhere is not False:
        whose = "as promised for" if found.elsewhere else "which is promised for"
        text = (
            f"{found.differing_ticks} of {found.ticks} ticks differ by rounding, {found.largest_difference:.3g} at "
            f"most in any input: within {ROUNDING:g}, {whose} a log of another machine or build; not equal to the byte"
        )
        console.print(text, style="yellow", markup=False, soft_wrap=True)
    else:
        console.print(f"{found.differing_ticks} of {found.ticks} ticks differ", style="bold red")
        if found.rounding:
            text = "by rounding alone, but log and machine name the same processor, kernels and versions"
            console.print(text, style="bold red", markup=False, soft_wrap=True)
    if found.lost_ticks:
        console.print(
            f"{found.lost_ticks} ticks could not be replayed or compared: the log has gaps", style="bold red"
        )
    first = found.first_difference
    if first is not None:
        text = (
            f"first at tick {first.tick}: {first.field} recorded {first.recorded}, replayed {first.replayed}"
        )
        console.print(text, markup=False, soft_wrap=True)
    if not (found.equal or found.rounding) and found.largest_difference is not None:
        console.print(f"largest difference of an input: {found.largest_difference:.3g}", markup=False)
    for note in found.notes:
        console.print(f"note: {note}", style="yellow", markup=False, soft_wrap=True)
    if as_json:
        terminal.emit(msgspec.to_builtins(found))
    return 0 if found.equal and not found.lost_ticks else 1


def report(file: Path, folder: Path | None, as_json: bool) -> int:
    """Pictures beside the log or in `folder`, and a table."""
    with log_packages():
        from run_log.errors import LogError
        from run_log.reading.reader import read_run
        from run_log.reporting import report as pictures
        from run_log.reporting.summary import summarise
    from tandem import summary_table

    console = terminal.console(as_json)
    try:
        ran = read_run(file)
        summary = summarise(ran)
        with console.status("drawing"):
            drawn = pictures.report(file, folder or file.parent)
    except LogError as error:
        raise Refused(str(error)) from error
    console.print(summary_table.table(summary))
    for picture in drawn:
        console.print(f"picture {picture}", markup=False, soft_wrap=True)
    if ran.note:
        console.print(ran.note, style="yellow", markup=False, soft_wrap=True)
    if as_json:
        terminal.emit({**msgspec.to_builtins(summary), "pictures": [str(picture) for picture in drawn]})
    return 0


def recover(file: Path, output: Path | None, as_json: bool) -> int:
    """A whole log beside the one that was cut short."""
    with log_packages():
        from run_log.errors import LogError
        from run_log.reading.recover import recover as make_whole

    try:
        saved = make_whole(file, output or file.with_suffix(f".recovered{file.suffix or '.mcap'}"))
    except LogError as error:
        raise Refused(str(error)) from error
    console = terminal.console(as_json)
    if saved.log is None:
        text = f"{file} is whole: {saved.messages} messages over {saved.seconds:.1f} s; nothing to do"
    else:
        text = f"{saved.log}: {saved.messages} messages over {saved.seconds:.1f} s saved from {file}"
        if saved.cut_at is not None:
            text += f", which was cut at byte {saved.cut_at} ({saved.lost_bytes} bytes of a torn record lost)"
    for part in [text, *saved.damage]:
        console.print(part, markup=False, soft_wrap=True)
    if as_json:
        terminal.emit(msgspec.to_builtins(saved))
    return 0


# -- configuration ----------------------------------------------------


def config_show(config: Config, as_json: bool) -> int:
    """The resolved configuration, as TOML or as JSON."""
    from tandem.checks import plant_of

    plant_of(config)
    if as_json:
        terminal.emit(to_tree(config))
    else:
        sys.stdout.write(to_toml(config))
    return 0


def progress_bar(console: Console) -> Progress:
    """A progress bar, on a terminal."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=console,
        disable=not console.is_terminal,
        transient=True,
    )


class log_packages:
    """Says how to install what reading and writing logs needs, where it is missing."""

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: Any, error: BaseException | None, at: Any) -> None:
        if isinstance(error, ModuleNotFoundError) and error.name in (
            "mcap",
            "zstandard",
            "matplotlib",
            "jinja2",
        ):
            raise Refused(f"logs need {error.name}: pip install 'tandem-control[log]'") from error
