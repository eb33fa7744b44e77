"""`make faults`: run every fault many times, print the outcome, and write the table into the document.

python -m verification.faults --runs 20 --document docs/results/faults.md
"""

from __future__ import annotations

import shlex
import shutil
import signal
import sys
from collections.abc import Iterator
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from benchmarks.document_block import DocumentError, conditions
from node_runtime import provenance
from verification.faults import table
from verification.faults.catalogue import ALL, Fault, Stage
from verification.faults.processes import link
from verification.faults.suite import Outcome, Results, ResultsError, judged
from verification.faults.table import Pair
from verification.faults.workers import Task, workers

START_AND_STOP_S = 8.0
"""Seconds of a run beside its own length: processes start and stop, and the log is replayed."""


@dataclass(frozen=True)
class Suite:
    """Run real processes with one fault at a random moment of each run. An interrupted suite continues."""

    runs: int = 20
    """Number of runs with each fault."""
    jobs: Annotated[int, tyro.conf.arg(metavar="INT")] = 1
    """Runs at a time. Each run uses up to one core, and simultaneous runs affect each other's figures."""
    only: Annotated[tuple[str, ...], tyro.conf.arg(metavar="TEXT")] = ()
    """Only faults whose name contains one of these; default: all."""
    seconds: float | None = None
    """Length of a run, counted from the first command; default: as each fault needs."""
    seed: int = 0
    """Seed of the moments of the faults; the runs' own seeds count up from it."""
    out: Path = Path("runs/faults")
    """Folder for results and for the files of runs in which a check failed."""
    document: Path | None = None
    """Document that receives the table between its two marks."""
    fresh: bool = False
    """Start again: ignore the results in --out."""
    show: Annotated[bool, tyro.conf.arg(name="list")] = False
    """List the faults and their durations, and run nothing."""
    set: list[str] = field(default_factory=list)
    """More section.key=value for all runs."""


def main(settings: Suite) -> int:
    """Return 0 if every check passed, 1 if one failed, 2 if the suite cannot run."""
    console = Console(stderr=True)
    chosen = [
        fault for fault in ALL if not settings.only or any(text in fault.name for text in settings.only)
    ]
    if settings.seconds is not None:
        chosen = [replace(fault, stage=replace(fault.stage, seconds=settings.seconds)) for fault in chosen]
    if not chosen:
        console.print(f"no fault has a name with {' or '.join(settings.only)} in it; --list names them")
        return 2
    if settings.jobs < 1:
        console.print("--jobs must be at least 1")
        return 2
    if settings.show:
        for fault in chosen:
            console.print(
                f"{minutes(seconds(fault) * settings.runs):>9}  {fault.name}", markup=False, highlight=False
            )
        console.print(f"{minutes(total(chosen, settings.runs)):>9}  in all, with the runs without a fault")
        return 0
    if not link.available():
        console.print("links to network namespaces need root; without it no fault can be inflicted on a link")
        return 2
    try:
        table.MARKS.check(settings.document)
        if settings.fresh:
            shutil.rmtree(settings.out, ignore_errors=True)
        results = Results(settings.out / "results.jsonl")
        # However the suite ends, it must remove its namespaces, mounts and processes.
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        pairs = _measure(settings, chosen, results, console)
        text = table.markdown(pairs, chosen, _head(settings))
        sys.stdout.write(text + "\n")
        table.MARKS.put(settings.document, text)
    except (DocumentError, ResultsError) as error:
        console.print(str(error), markup=False)
        return 2
    except KeyboardInterrupt:
        console.print(f"interrupted; the same command continues from {settings.out}")
        return 130
    return int(any(pair.outcome.not_held for found in pairs.values() for pair in found))


def seconds(fault: Fault) -> float:
    """Return the approximate duration of one run, in seconds."""
    return max(fault.stage.seconds, 2.0 + fault.span + fault.after) + START_AND_STOP_S


def total(faults: list[Fault], runs: int) -> float:
    """Return the approximate duration of all runs, those without a fault included, in seconds."""
    stages = {fault.stage for fault in faults}
    return runs * (sum(map(seconds, faults)) + sum(stage.seconds + START_AND_STOP_S for stage in stages))


def minutes(duration: float) -> str:
    return f"{duration / 60:.0f} min"


def _plan(faults: list[Fault], runs: int) -> Iterator[tuple[int, Fault | None, Stage]]:
    """Order runs in rounds, so that compared runs are close in time and every fault has some runs early."""
    stages = list(dict.fromkeys(fault.stage for fault in faults))
    for index in range(runs):
        for stage in stages:
            yield index, None, stage
        for fault in faults:
            yield index, fault, fault.stage


def _measure(
    settings: Suite, faults: list[Fault], results: Results, console: Console
) -> dict[str, list[Pair]]:
    plan = list(_plan(faults, settings.runs))
    duration = minutes(total(faults, settings.runs) / settings.jobs)
    console.print(f"{len(plan)} runs, about {duration}; after Ctrl-C the same command continues")
    pairs: dict[str, list[Pair]] = {}
    calm: dict[str, Outcome] = {}
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with workers(settings.jobs, results.put) as crew, Progress(*columns, console=console) as bar:
        task = bar.add_task("", total=len(plan))
        begun: list[Outcome | Future[Outcome]] = []
        for index, fault, stage in plan:
            name = "" if fault is None else fault.name
            known = results.find(name, stage.name, index, settings.seed)
            wanted = Task(name, stage, index, settings.seed, settings.out, tuple(settings.set))
            # A run without facts is repeated.
            begun.append(known if known is not None and known.facts is not None else crew.begin(wanted))
        for (_index, fault, stage), made in zip(plan, begun, strict=True):
            bar.update(task, description=("no fault, " + stage.name if fault is None else fault.name)[:40])
            outcome = made.result() if isinstance(made, Future) else made
            if fault is None:
                calm[stage.name] = outcome
                _say(bar, outcome, [outcome.error] if outcome.error else [])
            elif (without := calm[stage.name].facts) is not None:
                outcome = judged(outcome, fault, without)
                pairs.setdefault(fault.name, []).append(Pair(outcome, without))
                _say(bar, outcome, outcome.not_held)
            if not outcome.not_held and not outcome.error:
                shutil.rmtree(outcome.folder(settings.out), ignore_errors=True)
            bar.advance(task)
    return pairs


def _say(bar: Progress, outcome: Outcome, why: list[str]) -> None:
    for text in why:
        bar.console.print(
            f"{outcome.fault or 'no fault'}, run {outcome.index}: {text}", markup=False, style="red"
        )


def _head(settings: Suite) -> list[str]:
    command = shlex.join(["python", "-m", "verification.faults", *sys.argv[1:]])
    return conditions(command, f"Load at the end: {provenance.load():.1f}.")


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Suite)))
