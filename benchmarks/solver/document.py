"""Puts a run's figures into a document, between two marks, and its picture beside it."""

from __future__ import annotations

from pathlib import Path

from benchmarks.document_block import Marks
from benchmarks.solver.measure import CENTRE, Report
from benchmarks.solver.picture import draw
from benchmarks.solver.tables import COLUMNS, TEXT, ratios

MARKS = Marks.of("bench", "make bench")


def write(report: Report, path: Path, command: str) -> Path:
    """Replace what stands between the marks of `path`; returns the picture's path.

    Raises:
        DocumentError: no such file, or it lacks the marks.
    """
    MARKS.check(path)
    picture = path.with_suffix(".png")
    draw(report, picture)
    MARKS.put(path, _text(report, command, picture.name))
    return picture


def _text(report: Report, command: str, picture: str) -> str:
    facts = ", ".join(f"{name} {value}" for name, value in report.versions.items())
    machine = report.machine
    lines = [
        f"`{command}`, on {machine['processor']}, {machine['cores']} cores, {machine['system']}; {facts}; "
        f"{'; '.join(note for note in report.notes if note)}. "
        f"Load of the machine at the end of the run: {report.load:.1f}.",
        "",
        f"![Time of one solve over the horizon and over the width of the network]({picture})",
        "",
        f"Ratios of medians at N = {CENTRE}, network 5-32-32-4:",
        "",
        *_rows(["ratio", ""], [[name, f"{value:.3g}"] for name, value in ratios(report).items()], 1),
    ]
    if report.memory_mb:
        used = [[kind, f"{value:.0f}"] for kind, value in report.memory_mb.items()]
        lines += ["", "Peak memory of a process that holds one solver, N = 60, 5-32-32-4:", ""]
        lines += _rows(["process", "MB"], used, 1)
    cells = [[text(row) for _, text in COLUMNS] for row in report.rows]
    lines += ["", "All figures:", "", *_rows([name for name, _ in COLUMNS], cells, TEXT)]
    return "\n".join(lines)


def _rows(names: list[str], cells: list[list[str]], words: int) -> list[str]:
    rule = ["---" if index < words else "---:" for index in range(len(names))]
    return [f"| {' | '.join(row)} |" for row in (names, rule, *cells)]
