"""Punctuality of the live loop at several rates, and of the machine at the same time.

    python -m benchmarks.live.rates --document docs/results/rates.md

For each rate and solver mode `tandem run` runs for a while, with its trainer, recorder and live view. The idle
loop of `benchmarks.live.wakeups` runs beside it with a higher priority, so Tandem does not delay it. If it is
late, the machine is the cause, and a tick that is late at the same moment most likely has the same cause. "Late" is
defined as in the configuration: a tick begins later than a fifth of a period after its slot, or ends after its period.
A skipped slot counts too.
"""

from __future__ import annotations

import json
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from benchmarks.document_block import DocumentError, Marks, conditions
from benchmarks.live import process_usage
from node_runtime import provenance
from node_runtime.config.literals import SolverMode
from node_runtime.config.sections import Config
from node_runtime.realtime import clock
from protocol import topics
from run_log.errors import LogError
from run_log.reading.reader import read_run
from run_log.reporting.summary import Spread, summarise
from run_log.run import Run

MARKS = Marks.of("rates", "python -m benchmarks.live.rates")
COLUMNS = (
    "rate, Hz",
    "solver",
    "ticks",
    "on time, %",
    "late",
    "skipped",
    "empty loop on time, %",
    "late ticks beside a miss, %",
    "other ticks beside a miss, %",
    "tick p50 / p99, ms",
    "solve p50 / p99, ms",
    "of a core: controller, plant, router, others",
    "constraint violations",
    "replay",
)
FIRST = ("controller", "plant", "router")
START = "plant.x0=[0.4,1.6,1.1547,0]"
"""Well inside X. Twenty steps are too short at these rates to keep the paper's x0, even in lock-step."""


@dataclass(frozen=True)
class Rates:
    """Rates and modes, and the length of each run."""

    rates: tuple[int, ...] = (20, 100, 200, 500, 1000)
    """Samples a second."""
    modes: tuple[SolverMode, ...] = ("converged", "real_time")
    seconds: float = 20.0
    horizon: int = 20
    set: list[str] = field(default_factory=list)
    """More section.key=value for `tandem run`."""
    document: Path | None = None
    """Document that receives the table between its two marks."""


def main(settings: Rates) -> int:
    """Measure, print a Markdown table, and write it into the document if one is given."""
    try:
        MARKS.check(settings.document)
    except DocumentError as error:
        sys.stderr.write(f"{error}\n")
        return 2
    MARKS.put(settings.document, "\n".join(_table(settings)))
    return 0


def _table(settings: Rates) -> Iterator[str]:
    command = shlex.join(["python", "-m", "benchmarks.live.rates", *sys.argv[1:]])
    overrides = " ".join(f"--set {shlex.quote(override)}" for override in _overrides(settings, "SOLVER"))
    run = f"tandem run --rate RATE --seconds {settings.seconds:g} {overrides}"
    head = [
        *conditions(command, "Each row is the run"),
        "",
        *("```text", run, "```"),
        "",
        f"| {' | '.join(COLUMNS)} |",
        f"| {' | '.join(['---:'] * len(COLUMNS))} |",
    ]
    for line in head:
        yield _said(line)
    for rate in settings.rates:
        for mode in settings.modes:
            with tempfile.TemporaryDirectory() as folder:
                yield _said(f"| {' | '.join(_row(settings, rate, mode, Path(folder) / 'run.mcap'))} |")
    for line in ("", f"Load of the machine at the end: {provenance.load():.1f}."):
        yield _said(line)


def _said(line: str) -> str:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()
    return line


def _overrides(settings: Rates, mode: str) -> list[str]:
    ours = [f"controller.horizon={settings.horizon}", f"controller.solver.mode={mode}", START]
    return [*ours, *settings.set]


def _row(settings: Rates, rate: int, mode: SolverMode, log: Path) -> list[str]:
    arguments = ["run", "--json", "--rate", str(rate), "--seconds", str(settings.seconds), "--log", str(log)]
    for override in _overrides(settings, mode):
        arguments += ["--set", override]
    running = _tandem(*arguments)
    empty, cores = _beside(rate, settings.seconds, running)
    running.communicate()
    try:
        ran = read_run(log)
        found = summarise(ran)
    except LogError as error:
        return [str(rate), mode, f"no figures: {error}", *[""] * (len(COLUMNS) - 3)]
    slots = found.ticks + found.skipped_slots
    on_time = 100.0 * (1.0 - (found.late_ticks + found.skipped_slots) / slots)
    return [
        str(rate),
        mode,
        str(found.ticks),
        f"{on_time:.2f}",
        str(found.late_ticks),
        str(found.skipped_slots),
        "" if empty is None else f"{100.0 - empty['off_percent']:.2f}",
        *(["", ""] if empty is None else _beside_misses(ran, empty)),
        _spread(found.tick_ms),
        _spread(found.solve_ms),
        ", ".join(f"{share:.2f}" for share in cores),
        str(found.constraint_violations),
        _replayed(log),
    ]


def _beside(
    rate: int, seconds: float, running: subprocess.Popen[str]
) -> tuple[dict[str, Any] | None, list[float]]:
    """From the middle of the run: the idle loop's figures, None if it did not run, and processor time by process."""
    # Processes need some seconds to start; the loop waits here for the controller's first tick, not for the clock.
    assert running.stderr is not None
    for line in running.stderr:
        if "the run begins" in line:
            break
    module = ["-m", "benchmarks.live.wakeups", "--rate", str(rate), "--seconds", str(0.6 * seconds)]
    priority = ["--priority", str(Config().realtime.priority + 1)]
    before, began = process_usage.busy(running.pid), clock.now()
    done = subprocess.run([sys.executable, *module, *priority], capture_output=True, text=True, check=False)
    found: dict[str, Any] | None = json.loads(done.stdout) if done.returncode == 0 else None
    took, after = clock.now() - began, process_usage.busy(running.pid)
    share = {name: (after[name] - before[name]) / took for name in after if name in before}
    rest = sum(value for name, value in share.items() if name not in FIRST)
    return found, [*(share.get(name, 0.0) for name in FIRST), rest]


def _beside_misses(run: Run, empty: dict[str, Any]) -> list[str]:
    """Percentage of late ticks, and of all other ticks, that lie beside a miss of the idle loop.

    Beside: within a period of a moment at which the idle loop should have run and did not.
    """
    timing = {timing.seq: timing.tick_ms * 1e-3 for timing in run.timings}
    entries, period = run.entries(topics.TICK), run.config.period
    # Offset of the slots' clock against that of the log, from the message with the shortest delay.
    to_unix = min(
        entry.log_time * 1e-9 - entry.message.t - timing.get(entry.message.seq, 0.0) for entry in entries
    )
    missed = np.array(empty["missed"]).reshape(-1, 2)
    shares: dict[bool, list[bool]] = {True: [], False: []}
    for tick in run.ticks:
        slot = tick.t + to_unix
        if not empty["span"][0] <= slot <= empty["span"][1]:
            continue
        begin, over = slot - tick.skipped * period, slot + tick.lateness + timing.get(tick.seq, 0.0)
        off = tick.late or tick.skipped > 0 or over > slot + period
        shares[off].append(bool(((missed[:, 0] < over + period) & (missed[:, 1] > begin - period)).any()))
    return [f"{100.0 * np.mean(share):.1f}" if share else "" for share in (shares[True], shares[False])]


def _replayed(log: Path) -> str:
    told, _ = _tandem("replay", str(log), "--json").communicate()
    replay = json.loads(told)
    if not replay["equal"]:
        return "DIFFERS"
    return f"exact, {replay['lost_ticks']} ticks not in the log" if replay["lost_ticks"] else "exact"


def _tandem(*arguments: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-P", "-m", "tandem", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def _spread(spread: Spread | None) -> str:
    return "" if spread is None else f"{spread.p50:.2f} / {spread.p99:.2f}"


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Rates)))
