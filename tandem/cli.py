"""`tandem`: the command line. Every command has `--help`, and `--json` for one JSON object on stdout.

Exit codes: 0 success; 1 failure (a replay differs, a process died, the output could not be
written, except for a reader that closes the pipe); 2 the request cannot be done (a mistake in the arguments, the
configuration or the file); 3 the sets are empty, or their certificate does not hold; 130 interrupted.

Modules are imported when a command runs: `tandem --help` is quick, the trainer needs no CasADi, and
the controller no torch.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Annotated, Any

import tyro
from tyro.conf import subcommand

from tandem.commands.architecture import ArchitectureCommand
from tandem.commands.base import INTERRUPTED, OPTIONAL_PACKAGES, Command
from tandem.commands.config import ConfigCommand
from tandem.commands.experiment import Experiment
from tandem.commands.export import Export
from tandem.commands.health import Health
from tandem.commands.identify import Identify
from tandem.commands.keys import KeysCommand
from tandem.commands.model import ModelCommand
from tandem.commands.operating.by_hand import Auto, Manual, Pause
from tandem.commands.operating.set_point import SetPoint
from tandem.commands.processes import Controller, Live, Plant, Record, Router, Trainer
from tandem.commands.recover import Recover
from tandem.commands.replay import Replay
from tandem.commands.report import Report
from tandem.commands.run import Run
from tandem.commands.sets import SetsCommand
from tandem.commands.simulate import Simulate
from tandem.streams import never_failing

AnyCommand = (
    Annotated[Run, subcommand("run")]
    | Annotated[Simulate, subcommand("simulate")]
    | Annotated[Replay, subcommand("replay")]
    | Annotated[Report, subcommand("report")]
    | Annotated[Export, subcommand("export")]
    | Annotated[Recover, subcommand("recover")]
    | Annotated[Router, subcommand("router")]
    | Annotated[Controller, subcommand("controller")]
    | Annotated[Trainer, subcommand("trainer")]
    | Annotated[Plant, subcommand("plant")]
    | Annotated[Record, subcommand("record")]
    | Annotated[Live, subcommand("live")]
    | Annotated[Health, subcommand("health")]
    | Annotated[Manual, subcommand("manual")]
    | Annotated[Pause, subcommand("pause")]
    | Annotated[Auto, subcommand("auto")]
    | Annotated[SetPoint, subcommand("set-point")]
    | Annotated[Experiment, subcommand("experiment")]
    | Annotated[SetsCommand, subcommand("sets")]
    | Annotated[ModelCommand, subcommand("model")]
    | Annotated[Identify, subcommand("identify")]
    | Annotated[KeysCommand, subcommand("keys")]
    | Annotated[ConfigCommand, subcommand("config")]
    | Annotated[ArchitectureCommand, subcommand("architecture")]
)


def main(argv: Sequence[str] | None = None) -> int:
    """Parse the arguments, run the command, print errors as one message; return the exit code."""
    with never_failing() as output:
        try:
            code = _do(sys.argv[1:] if argv is None else argv)
        except SystemExit as end:  # after --help, or a mistake in the arguments
            if not isinstance(end.code, int):
                raise
            code = end.code
        return output.exit_code(code)


def parse(argv: Sequence[str]) -> Command:
    """Return the command that these arguments ask for, without running it.

    Raises:
        SystemExit: after `--help`, or a mistake in the arguments.
    """
    parsed: Any = tyro.cli(
        AnyCommand,
        prog="tandem",
        description="Learning-based model predictive control that learns while it runs. --version says which this is.",
        args=argv,
        config=(tyro.conf.OmitArgPrefixes, tyro.conf.OmitSubcommandPrefixes, tyro.conf.FlagCreatePairsOff),
    )
    return getattr(parsed, "action", parsed)


def _do(argv: Sequence[str]) -> int:
    from tandem import terminal

    if list(argv) == ["--version"]:
        from importlib.metadata import version

        terminal.write(f"tandem {version('tandem-control')}\n")
        return 0
    command = parse(argv)
    from node_runtime.config.strict import ConfigError
    from run_log.errors import LogError

    try:
        return command.run()
    except ConfigError as error:
        text, file = str(error), getattr(command, "config", None)
        named = file is None or text.startswith(("--", str(file)))
        terminal.complain(text if named else f"{file}: {text}", command.json)
        return 2
    except (terminal.Refused, LogError) as error:
        terminal.complain(str(error), command.json)
        return 2
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package not in OPTIONAL_PACKAGES:
            raise
        how = f"pip install 'tandem-control[{command.EXTRAS}]'"
        terminal.complain(f"this command needs {package}: {how}", command.json)
        return 2
    except KeyboardInterrupt:
        return INTERRUPTED
