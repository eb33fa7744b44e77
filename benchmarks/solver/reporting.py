"""Results of the rows: ratios, tables for a terminal, and a document with its picture."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from textwrap import wrap

from rich.table import Table

from benchmarks.document_block import Marks
from benchmarks.solver.measure import CENTRE, WIDTH, Report, Row
from benchmarks.solver.picture import draw

MARKS = Marks.of("bench", "make bench")
COLUMNS: tuple[tuple[str, Callable[[Row], str]], ...] = (
    ("solver", lambda row: row.solver),
    ("mode", lambda row: row.mode),
    ("oracle", lambda row: row.oracle),
    ("N", lambda row: str(row.N)),
    ("width", lambda row: "-" if row.width is None else str(row.width)),
    ("compiled", lambda row: "yes" if row.compiled else "no"),
    ("median ms", lambda row: milliseconds(row.median_ms)),
    ("p99 ms", lambda row: milliseconds(row.p99_ms)),
    ("max ms", lambda row: milliseconds(row.max_ms)),
    ("cold ms", lambda row: milliseconds(row.cold_median_ms)),
    ("iterations", lambda row: f"{row.iterations:.1f}"),
    ("error", lambda row: f"{row.error:.0e}"),
    ("stopped", lambda row: f"{row.failures} of {row.solves}" if row.failures else "-"),
)
TEXT = 3
"""Number of text columns from the left; the others are numbers."""


def milliseconds(value: float) -> str:
    """Format with at most three digits, and no more than microseconds."""
    return f"{value:.3f}" if value < 1 else f"{value:.3g}"


def ratios(report: Report, N: int = CENTRE) -> dict[str, float]:
    """Ratios of medians at the horizon N with a 5-32-32-4 network, by name; unmeasured ones are left out."""
    compiled = any(row.compiled for row in report.rows)

    def ours(mode: str, oracle: str) -> float | None:
        row = report.find("tandem", mode, oracle, N, WIDTH if oracle == "dnn" else None, compiled)
        return row.median_ms if row else None

    def theirs(solver: str, oracle: str) -> float | None:
        row = report.find(solver, "converged", oracle, N, WIDTH if oracle == "dnn" else None, False)
        return row.median_ms if row else None

    def iteration(oracle: str) -> float | None:
        parts = [ours("preparation", oracle), ours("feedback", oracle)]
        return sum(part for part in parts if part is not None) if None not in parts else None

    converged, feedback = ours("converged", "dnn"), ours("feedback", "dnn")
    pairs = {}
    for solver in ("ipopt", "ipopt-hard", "ipopt-hard-gauss-newton", "sqpmethod-daqp", "sqpmethod-qrqp"):
        pairs[f"{solver} / converged, both dnn"] = (theirs(solver, "dnn"), converged)
        pairs[f"{solver} / feedback, both dnn"] = (theirs(solver, "dnn"), feedback)
    for solver in ("ipopt", "ipopt-hard"):
        pairs[f"{solver} linear / converged dnn"] = (theirs(solver, "linear"), converged)
    pairs["dnn / linear, converged"] = (converged, ours("converged", "linear"))
    pairs["dnn / linear, real-time iteration"] = (iteration("dnn"), iteration("linear"))
    pairs["dnn / linear, feedback alone"] = (feedback, ours("feedback", "linear"))
    return {name: a / b for name, (a, b) in pairs.items() if a is not None and b is not None and b > 0}


def table(report: Report) -> Table:
    """Print all rows, for a terminal."""
    shown = Table(box=None, pad_edge=False, header_style="bold")
    for index, (name, _) in enumerate(COLUMNS):
        shown.add_column(name, justify="left" if index < TEXT else "right", no_wrap=True)
    for row in report.rows:
        shown.add_row(*(text(row) for _, text in COLUMNS))
    return shown


def ratio_table(report: Report) -> Table:
    """Print the ratios, for a terminal."""
    shown = Table(box=None, pad_edge=False, header_style="bold")
    shown.add_column(f"ratio of medians, N = {CENTRE}")
    shown.add_column("", justify="right")
    for name, value in ratios(report).items():
        shown.add_row(name, f"{value:.3g}")
    return shown


def write(report: Report, path: Path, command: str) -> Path:
    """Replace the text between the marks of `path`; return the picture's path.

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
    measured = (
        f"`{command}`, on {machine['processor']}, {machine['cores']} cores, {machine['system']}; {facts}; "
        f"{'; '.join(note for note in report.notes if note)}. "
        f"Load of the machine at the end of the run: {report.load:.1f}."
    )
    lines = [
        *wrap(measured, 120, break_long_words=False, break_on_hyphens=False),
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
