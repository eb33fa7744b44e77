"""`make fuzz`: send millions of bad payloads through every reader; none may crash, hang or grow.

python -m verification.fuzz --payloads 10000000 --document docs/results/faults.md
"""

from __future__ import annotations

import logging
import multiprocessing
import shlex
import sys
import tempfile
from collections import Counter
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from pathlib import Path

import msgspec
import tyro
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from benchmarks.document_block import DocumentError, Marks, conditions
from verification.fuzz.targets import ACCEPTED
from verification.fuzz.work import Finding, Report, Work, merge

MARKS = Marks.of("fuzz", "make fuzz")
GROWTH_KB = 8 * 1024
"""kB that a process may grow after its first tenth: caches of the allocator, not a leak of millions of payloads."""


@dataclass(frozen=True)
class Fuzz:
    """Send bad payloads through every reader of bytes from outside."""

    payloads: int = 10_000_000
    """In all."""
    jobs: int = 2
    """Processes."""
    seed: int = 0
    out: Path = Path("runs/fuzz")
    """Folder of the figures, and of payloads that caused a failure."""
    document: Path | None = None
    """Document that receives the table between its two marks."""


def main(settings: Fuzz) -> int:
    """Return 0 if nothing crashed, hung or grew, 1 if something did, 2 if the document lacks the marks."""
    console = Console(stderr=True)
    try:
        MARKS.check(settings.document)
    except DocumentError as error:
        console.print(str(error), markup=False)
        return 2
    settings.out.mkdir(parents=True, exist_ok=True)
    reports = measure(settings, console)
    (settings.out / "results.json").write_bytes(msgspec.json.format(msgspec.json.encode(reports)))
    for finding in (finding for report in reports for finding in report.findings):
        _keep(finding, settings.out, console)
    lines = table(reports, settings)
    sys.stdout.write("\n".join(lines) + "\n")
    MARKS.put(settings.document, "\n".join(lines))
    grown = any(growth(report) > GROWTH_KB for report in reports)
    return int(grown or any(report.findings or not report.ended for report in reports))


def measure(settings: Fuzz, console: Console) -> list[Report]:
    """One report a process; the work of a process that hung or died is in its own report."""
    share = settings.payloads // settings.jobs
    context = multiprocessing.get_context("spawn")
    latest: dict[Connection, Report] = {}
    with tempfile.TemporaryDirectory() as folder:
        processes = []
        for job in range(settings.jobs):
            here, there = context.Pipe(duplex=False)
            work = Work(share, settings.seed * settings.jobs + job, folder)
            process = context.Process(target=work.run, args=(there,), daemon=True)
            process.start()
            there.close()
            processes.append(process)
            latest[here] = Report()
        columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn())
        with Progress(*columns, console=console) as bar:
            task = bar.add_task(f"{settings.payloads:,} payloads", total=share * settings.jobs)
            open_ = set(latest)
            while open_:
                for ready in wait(list(open_)):
                    assert isinstance(ready, Connection)
                    try:
                        latest[ready] = msgspec.json.decode(ready.recv_bytes(), type=Report)
                    except EOFError:
                        open_.discard(ready)
                bar.update(task, completed=sum(report.payloads for report in latest.values()))
        for process in processes:
            process.join()
    return list(latest.values())


def growth(report: Report) -> int:
    """Growth in kB from after the first tenth to the end."""
    kept = report.rss_kb[max(1, len(report.rss_kb) // 10) :]
    return kept[-1] - kept[0] if len(kept) > 1 else 0


def table(reports: list[Report], settings: Fuzz) -> list[str]:
    """Return the figures as Markdown."""
    command = shlex.join(["python", "-m", "verification.fuzz", *sys.argv[1:]])
    found = merge(reports)
    payloads = sum(report.payloads for report in reports)
    seconds = max((report.seconds for report in reports), default=0.0)
    lines = [
        *conditions(command, f"{payloads:,} payloads in {settings.jobs} processes, {seconds:.0f} s."),
        "",
        "| reader | payloads | accepted | refused | slowest, ms | crashed |",
        "| --- | ---: | ---: | --- | ---: | ---: |",
    ]
    for name, one in found.items():
        refused = Counter({kind: count for kind, count in one.kinds.items() if kind not in ACCEPTED})
        accepted = sum(one.kinds.values()) - sum(refused.values())
        why = ", ".join(f"{kind} {count:,}" for kind, count in refused.most_common(6))
        total = sum(one.kinds.values()) + one.crashed
        lines.append(
            f"| {name} | {total:,} | {accepted:,} | {why} | {one.slowest_ns / 1e6:.1f} | {one.crashed} |"
        )
    lines.append("")
    for report in reports:
        rss = (
            [f"{value / 1024:.1f}" for value in (report.rss_kb[0], report.rss_kb[-1])]
            if report.rss_kb
            else []
        )
        after = f"{growth(report) / 1024:+.1f} MB after its first tenth"
        lines.append(f"- Memory of a process, first and last: {' and '.join(rss)} MB, {after}.")
        if not report.ended:
            lines.append("- A process did not end: it hung or died.")
    return lines


def _keep(finding: Finding, out: Path, console: Console) -> None:
    path = out / f"crash-{finding.digest[:12]}"
    path.write_bytes(finding.payload)
    console.print(f"{finding.target}: {finding.error}; the payload is in {path}", markup=False, style="red")


if __name__ == "__main__":
    logging.disable()
    sys.exit(main(tyro.cli(Fuzz)))
