"""`tandem bench solver`."""

from __future__ import annotations

from pathlib import Path

import msgspec

from tandem import terminal
from tandem.terminal import Refused

TABLE = 132
"""Characters that the table of all figures needs."""


def solver(quick: bool, document: Path | None, as_json: bool) -> int:
    """Measure, show, and put the figures into a document where one is given."""
    try:
        from benchmarks.document_block import DocumentError
        from benchmarks.solver import document as documents
        from benchmarks.solver import tables
        from benchmarks.solver.measure import QUICK, Plan, measure
    except ModuleNotFoundError as error:
        if error.name not in ("matplotlib", "mcap", "zstandard"):
            raise
        raise Refused(f"benchmarks need {error.name}: pip install 'tandem-control[log]'") from error
    from tandem.terminal import progress_bar

    console = terminal.console(as_json)
    try:
        documents.MARKS.check(document)
        with progress_bar(console) as bar:
            task = bar.add_task("starting", total=None)
            report = measure(
                QUICK if quick else Plan(),
                lambda what, done, of: bar.update(task, description=what, completed=done, total=of),
            )
        # A table cut to the width of a narrow terminal, or of a pipe, would lose its digits.
        console.width = max(console.width, TABLE)
        console.print(tables.table(report))
        console.print()
        console.print(tables.ratio_table(report))
        for kind, value in report.memory_mb.items():
            console.print(f"peak memory, {kind}: {value:.0f} MB", markup=False)
        for note in report.notes:
            console.print(f"note: {note}", markup=False, soft_wrap=True)
        if document is not None:
            words = ["tandem", "bench", "solver", *(["--quick"] if quick else [])]
            picture = documents.write(report, document, " ".join(words))
            console.print(f"written {document} and {picture}", markup=False, soft_wrap=True)
    except DocumentError as error:
        raise Refused(str(error)) from error
    if as_json:
        terminal.emit({**msgspec.to_builtins(report), "ratios": tables.ratios(report)})
    return 0
