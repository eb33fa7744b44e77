"""Measure, print, and write the figures into a document: `python -m benchmarks.solver`."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import msgspec
import tyro
from rich.progress import Progress

from benchmarks.document_block import DocumentError
from benchmarks.solver import reporting
from benchmarks.solver.measure import QUICK, Scope, measure
from tandem import terminal

TABLE = 132
"""Width in characters of the table of all figures."""


@dataclass(frozen=True)
class Benchmark:
    """Time the solver beside others on the same recorded states: horizons, widths, oracles, modes. About 10 minutes."""

    quick: bool = False
    """Only a few cases, within a minute."""
    document: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Rewrite the figures between the marks in this Markdown file, and the picture beside it."""
    json: bool = False
    """Print one JSON object to standard output; text for a person goes to standard error."""


def main(chosen: Benchmark) -> int:
    """Return 0, or 2 if the document cannot take the figures."""
    console = terminal.console(chosen.json)
    try:
        reporting.MARKS.check(chosen.document)
        with Progress(console=console, disable=not console.is_terminal, transient=True) as bar:
            task = bar.add_task("starting", total=None)
            report = measure(
                QUICK if chosen.quick else Scope(),
                lambda what, done, of: bar.update(task, description=what, completed=done, total=of),
            )
        # A table cut to the width of a narrow terminal, or of a pipe, would lose digits.
        console.width = max(console.width, TABLE)
        console.print(reporting.table(report))
        console.print()
        console.print(reporting.ratio_table(report))
        for kind, value in report.memory_mb.items():
            console.print(f"peak memory, {kind}: {value:.0f} MB", markup=False)
        for note in report.notes:
            console.print(f"note: {note}", markup=False, soft_wrap=True)
        if chosen.document is not None:
            command = "python -m benchmarks.solver" + (" --quick" if chosen.quick else "")
            picture = reporting.write(report, chosen.document, command)
            console.print(f"written {chosen.document} and {picture}", markup=False, soft_wrap=True)
    except DocumentError as error:
        terminal.complain(str(error), chosen.json)
        return 2
    if chosen.json:
        terminal.emit({**msgspec.to_builtins(report), "ratios": reporting.ratios(report)})
    return 0


if __name__ == "__main__":
    sys.exit(
        main(tyro.cli(Benchmark, prog="python -m benchmarks.solver", config=(tyro.conf.FlagCreatePairsOff,)))
    )
