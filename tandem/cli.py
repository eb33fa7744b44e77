"""`tandem`: the command line. Every command has `--help`, and `--json` for one JSON object on stdout.

Exit codes: 0 it went well; 1 it did not (a replay differs, a process died); 2 what was asked cannot be done
(a mistake in the arguments, the configuration or the file); 3 there are no such sets, or their certificate does not
hold; 130 interrupted.

What a command needs is imported when it runs: so `tandem --help` is quick, the trainer needs no CasADi, and
the controller no torch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, get_args

import tyro
from tyro.conf import Positional, Suppress, UseAppendAction, arg, subcommand

from node_runtime.config.literals import OracleName, ProcessName, TighteningName
from tandem.commands.base import FROM_CONFIG, Command, Configured
from tandem.commands.keys_arguments import KeysCommand
from tandem.commands.sets.arguments import SetsCommand


@dataclass(frozen=True, kw_only=True)
class Run(Configured):
    """Run router, recorder, trainer, plant and controller here, watch them, and leave a log and a picture."""

    seconds: Annotated[float, arg(metavar="S")] = 20.0
    """How long, counted from the first command."""
    oracle: Annotated[
        OracleName | None, arg(metavar="linear|l2nw|dnn|perfect", help_behavior_hint=FROM_CONFIG)
    ] = None
    """What the controller learns with."""
    rate: Annotated[float | None, arg(metavar="HZ", help_behavior_hint=FROM_CONFIG)] = None
    """Samples a second."""
    seed: Annotated[int | None, arg(metavar="INT", help_behavior_hint=FROM_CONFIG)] = None
    """Of everything random."""
    log: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="(default: run.mcap)")] = None
    """The log; a file of that name is moved aside, never overwritten. The picture lies beside it."""
    no_trainer: bool = False
    """Start no trainer here: it comes from another machine (docs/remote.md), or not at all."""

    def flags(self) -> dict[str, tuple[str, Any]]:
        return {
            "--oracle": ("controller.oracle", self.oracle),
            "--rate": ("rate", self.rate),
            "--seed": ("seed", self.seed),
            "--log": ("log.path", None if self.log is None else str(self.log)),
        }

    def run(self) -> int:
        config, given = self.resolve()
        from tandem.commands import run

        return run.run(
            config, self.seconds, "endpoint" in given.get("bus", {}), self.json, trainer=not self.no_trainer
        )


@dataclass(frozen=True, kw_only=True)
class Simulate(Configured):
    """Controller, trainer and plant in lock-step in one process: deterministic, faster than real time."""

    oracle: Annotated[
        OracleName | None, arg(metavar="linear|l2nw|dnn|perfect", help_behavior_hint=FROM_CONFIG)
    ] = None
    """What the controller learns with."""
    steps: Annotated[int, arg(metavar="INT")] = 200
    """How many ticks."""
    seed: Annotated[int | None, arg(metavar="INT", help_behavior_hint=FROM_CONFIG)] = None
    """Of everything random; the same seed gives the same run, bit for bit."""
    tightening: Annotated[
        TighteningName | None,
        arg(metavar="none|first_step|tube|invariant", help_behavior_hint=FROM_CONFIG),
    ] = None
    """How the nominal constraints are tightened."""
    adapt_only: bool = False
    """Never train the hidden layers; adapt the last one only."""
    x0: Annotated[
        list[float] | None, arg(metavar="X...", help_behavior_hint="(default: the plant's own)")
    ] = None
    """Initial state, in the plant's own units."""
    log: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="(default: none is written)")] = None
    """Write the run's log too, in the format of a live run."""

    def flags(self) -> dict[str, tuple[str, Any]]:
        return {
            "--oracle": ("controller.oracle", self.oracle),
            "--seed": ("seed", self.seed),
            "--tightening": ("controller.tightening", self.tightening),
            "--adapt-only": ("trainer.enabled", False if self.adapt_only else None),
            "--x0": ("plant.x0", self.x0),
        }

    def run(self) -> int:
        config, _ = self.resolve()
        from tandem.commands import various

        return various.simulate(config, self.steps, self.adapt_only, self.log, self.json)


@dataclass(frozen=True, kw_only=True)
class Replay(Command):
    """Give a log's ticks to a fresh controller and compare every command and keyframe, byte for byte."""

    file: Annotated[Positional[Path], arg(metavar="FILE")]
    """A log that `tandem run` or `tandem simulate --log` wrote."""
    from_tick: Annotated[int | None, arg(metavar="INT", help_behavior_hint="(default: the first)")] = None
    """Start at this tick, from the nearest keyframe before it."""
    set: Annotated[UseAppendAction[list[str]], arg(metavar="SECTION.KEY=VALUE")] = field(default_factory=list)
    """Replay with another value than the log's configuration has."""

    def run(self) -> int:
        from tandem.commands import various

        return various.replay(self.file, self.from_tick, self.set, self.json)


@dataclass(frozen=True, kw_only=True)
class Report(Command):
    """Draw a run and tabulate it, from its log alone."""

    file: Annotated[Positional[Path], arg(metavar="FILE")]
    """The log."""
    output: Annotated[Path | None, arg(metavar="FOLDER", help_behavior_hint="(default: the log's)")] = None
    """Where the pictures go."""

    def run(self) -> int:
        from tandem.commands import various

        return various.report(self.file, self.output, self.json)


@dataclass(frozen=True, kw_only=True)
class Recover(Command):
    """Make a log whole whose recorder did not end cleanly."""

    file: Annotated[Positional[Path], arg(metavar="FILE")]
    """The log; it stays as it is."""
    output: Annotated[
        Path | None, arg(metavar="FILE", help_behavior_hint="(default: NAME.recovered.mcap)")
    ] = None
    """Where the whole log goes."""

    def run(self) -> int:
        from tandem.commands import various

        return various.recover(self.file, self.output, self.json)


@dataclass(frozen=True, kw_only=True)
class Router(Configured):
    """The Zenoh router that all processes are clients of."""

    def run(self) -> int:
        config, _ = self.resolve()
        from tandem.commands import various

        return various.router(config, self.json)


@dataclass(frozen=True, kw_only=True)
class Controller(Configured):
    """The controller: one tick a period, latch, solve, command."""

    def run(self) -> int:
        config, _ = self.resolve()
        from tandem.commands import various

        return various.controller(config, self.json)


@dataclass(frozen=True, kw_only=True)
class Trainer(Configured):
    """The trainer: collects samples, trains the hidden layers, sends them. Needs torch, not CasADi."""

    plants: str | None = None
    """Train for all plants whose names match, e.g. 'jet*' (docs/fleet.md); by default the one named in the
    configuration."""

    def run(self) -> int:
        config, _ = self.resolve()
        from tandem.commands import various

        return various.trainer(config, self.plants, self.json)


@dataclass(frozen=True, kw_only=True)
class Plant(Configured):
    """The plant: integrates the truth in real time, applies commands as they arrive."""

    def run(self) -> int:
        config, _ = self.resolve()
        from tandem.commands import various

        return various.plant(config, self.json)


@dataclass(frozen=True, kw_only=True)
class Record(Configured):
    """The recorder: writes everything on the bus to a log."""

    log: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint=FROM_CONFIG)] = None
    """The log; must not exist yet."""

    def flags(self) -> dict[str, tuple[str, Any]]:
        return {"--log": ("log.path", None if self.log is None else str(self.log))}

    def run(self) -> int:
        config, _ = self.resolve()
        from tandem.commands import various

        return various.record(config, self.json)


@dataclass(frozen=True, kw_only=True)
class Health(Configured):
    """Ask the bus how a process is: exit code 0 when it is ready or running, 1 when not. Made for health checks."""

    process: Annotated[Positional[ProcessName], arg(metavar="|".join(get_args(ProcessName)))]
    """Which process."""
    seconds: Annotated[float, arg(metavar="S")] = 3.0
    """How long to listen; a process speaks twice a second."""

    def run(self) -> int:
        config, _ = self.resolve()
        from tandem.commands import health

        return health.run(config, self.process, self.seconds, self.json)


@dataclass(frozen=True, kw_only=True)
class ConfigShow(Configured):
    """Print the whole configuration as it is resolved: file, then --set, then defaults."""

    def run(self) -> int:
        config, _ = self.resolve()
        from tandem.commands import various

        return various.config_show(config, self.json)


@dataclass(frozen=True, kw_only=True)
class ConfigCommand:
    """Work with the configuration."""

    # A union, so that `show` is a word of its own on the command line.
    action: Annotated[ConfigShow, subcommand("show")] | Annotated[None, Suppress]


@dataclass(frozen=True, kw_only=True)
class BenchSolver(Command):
    """Time the solver beside others on the same recorded states: horizons, widths, oracles, modes. About 10 minutes."""

    quick: bool = False
    """A few cases only, within a minute."""
    document: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="(default: none)")] = None
    """Rewrite the figures between the marks in this Markdown file, and the picture beside it."""

    def run(self) -> int:
        from benchmarks.solver import command

        return command.solver(self.quick, self.document, self.json)


@dataclass(frozen=True, kw_only=True)
class Experiment(Command):
    """Run an experiment, `paper` or a file of your own, and report it on one page; `list` says which there are."""

    what: Annotated[Positional[str], arg(metavar="NAME|FILE.toml|list")]
    """A shipped experiment, your own file (docs/experiments.md), or `list`."""
    out: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="(needed, except for list)")] = None
    """Where the report goes. An experiment that was interrupted goes on from what lies there."""
    quick: bool = False
    """Few seeds, states and values: whether everything works, in minutes."""
    jobs: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: one a core)")] = None
    """Runs at the same time; the figures do not depend on it."""
    only: Annotated[str | None, arg(metavar="GROUP", help_behavior_hint="(default: all)")] = None
    """One group of the experiment."""

    def run(self) -> int:
        from tandem import terminal
        from tandem.commands import experiment

        if self.what == "list":
            return experiment.show_list(self.json)
        if self.out is None:
            raise terminal.Refused("--out DIR is missing: where should the report go?")
        return experiment.run(self.what, self.out, self.quick, self.jobs, self.only, self.json)


@dataclass(frozen=True, kw_only=True)
class BenchCommand:
    """Measure how fast it is."""

    action: Annotated[BenchSolver, subcommand("solver")] | Annotated[None, Suppress]


AnyCommand = (
    Annotated[Run, subcommand("run")]
    | Annotated[Simulate, subcommand("simulate")]
    | Annotated[Replay, subcommand("replay")]
    | Annotated[Report, subcommand("report")]
    | Annotated[Recover, subcommand("recover")]
    | Annotated[Router, subcommand("router")]
    | Annotated[Controller, subcommand("controller")]
    | Annotated[Trainer, subcommand("trainer")]
    | Annotated[Plant, subcommand("plant")]
    | Annotated[Record, subcommand("record")]
    | Annotated[Health, subcommand("health")]
    | Annotated[Experiment, subcommand("experiment")]
    | Annotated[SetsCommand, subcommand("sets")]
    | Annotated[KeysCommand, subcommand("keys")]
    | Annotated[BenchCommand, subcommand("bench")]
    | Annotated[ConfigCommand, subcommand("config")]
)


def main(argv: Sequence[str] | None = None) -> int:
    """Parse, do, and say what is wrong in one message; returns the exit code."""
    parsed: Any = tyro.cli(
        AnyCommand,
        prog="tandem",
        description="Learning-based model predictive control that learns while it runs.",
        args=argv,
        config=(tyro.conf.OmitArgPrefixes, tyro.conf.OmitSubcommandPrefixes, tyro.conf.FlagCreatePairsOff),
    )
    command: Command = getattr(parsed, "action", parsed)
    from node_runtime.config.strict import ConfigError
    from tandem import terminal

    try:
        return command.run()
    except ConfigError as error:
        text, file = str(error), getattr(command, "config", None)
        named = file is None or text.startswith(("--", str(file)))
        terminal.complain(text if named else f"{file}: {text}", command.json)
        return 2
    except terminal.Refused as error:
        terminal.complain(str(error), command.json)
        return 2
    except KeyboardInterrupt:
        return 130
