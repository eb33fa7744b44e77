"""`make soak`: check for growth and lateness in a long run.

    python -m verification.soak --minutes 30 --document docs/results/faults.md

`tandem run` runs at 50 Hz with its trainer, recorder and live view. The memory of every process is read every ten
seconds. The idle loops of `benchmarks.live.stalls` run beside it and show which ticks the machine itself made late.
"""

from __future__ import annotations

import json
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import tyro
from matplotlib.figure import Figure
from mcap.records import Channel, Message
from rich.console import Console
from rich.progress import Progress
from scipy import stats

from benchmarks.document_block import DocumentError, Marks, conditions
from benchmarks.live import process_usage, stalls
from node_runtime.config.sections import Config
from protocol import codec, topics
from protocol import messages as m
from run_log import raw_message
from run_log.errors import LogError
from run_log.reading.mcap_scan import Scan
from run_log.reading.reader import read_run
from run_log.replaying.replay import replay
from run_log.reporting.plots import BLACK, BLUE, GREEN, GREY, SKY, VERMILION
from run_log.writing.parts import existing_parts

MARKS = Marks.of("soak", "make soak")
LOOKS = {
    "supervisor": (GREY, ":"),
    "router": (BLACK, "--"),
    "recorder": (VERMILION, "-"),
    "trainer": (GREEN, "-"),
    "plant": (SKY, "-."),
    "controller": (BLUE, "-"),
}
CONFIDENCE = 0.95
AT_LEAST = 4
"""Readings after the first minute; with fewer there is no slope."""


@dataclass(frozen=True)
class Soak:
    """A long run, its memory and its lateness."""

    minutes: float = 30.0
    rate: float = 50.0
    split_minutes: float = 5.0
    """Minutes of a part of the log; the recorder's memory rises until its end and falls again."""
    every: float = 10.0
    """Seconds between two readings of the memory."""
    warm: float = 60.0
    """Seconds that do not count: modules are loaded and buffers fill."""
    set: list[str] = field(default_factory=list)
    """More section.key=value for `tandem run`."""
    out: Path = Path("runs/soak")
    """Folder of figures and picture."""
    document: Path | None = None
    """Document that receives the table between its two marks; the picture is placed beside it."""


class Memory(msgspec.Struct, frozen=True):
    """Memory of one process in kB, over minutes since the first command; the slope is that after the first minute."""

    minutes: list[float]
    rss: list[int]
    slope: float | None
    """kB a minute."""
    uncertainty: float | None
    """Half-width of the slope's 95 % confidence interval."""
    second_half: float | None
    """Slope in the second half of the run, where bounded buffers are full."""


class Lateness(msgspec.Struct, frozen=True):
    """Late ticks of the control loop."""

    ticks: int
    late: int
    """Ticks that began late, ended after their period, or were skipped."""
    by_machine: int
    """Of these, ticks while an idle loop of the highest priority was late too."""
    stalls: int
    """Times that an idle loop woke more than 2 ms late."""
    longest_stall_ms: float


def main(settings: Soak) -> int:
    """Return 0, 1 if the run failed, or 2 if the document lacks the marks."""
    console = Console(stderr=True)
    try:
        MARKS.check(settings.document)
    except DocumentError as error:
        console.print(str(error), markup=False)
        return 2
    settings.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=settings.out) as folder:
        found = _run(settings, Path(folder), console)
        if found is None:
            return 1
        memory, figures = found
        parts = existing_parts(Path(folder) / "run.mcap")
        lateness = late(parts, stalls.read(Path(folder) / "stalls.txt"), settings.rate)
        console.print("replaying")
        replays = replayed(parts)
    picture = (
        settings.out / "soak.png" if settings.document is None else settings.document.with_name("soak.png")
    )
    draw(memory, settings.warm / 60.0, picture)
    results = {"memory": memory, "lateness": lateness, "replays": replays, "run": figures}
    (settings.out / "results.json").write_bytes(msgspec.json.format(msgspec.json.encode(results)))
    body = "\n".join(_table(memory, lateness, replays, figures, picture.name))
    sys.stdout.write(body + "\n")
    MARKS.put(settings.document, body)
    return 0


def _run(settings: Soak, folder: Path, console: Console) -> tuple[dict[str, Memory], dict[str, Any]] | None:
    """Return memory by process and the run's own summary; None if it failed, with a message."""
    seconds = 60.0 * settings.minutes
    words = ["run", "--json", "--rate", str(settings.rate), "--seconds", str(seconds)]
    words += ["--log", str(folder / "run.mcap"), "--set", f"log.split_minutes={settings.split_minutes}"]
    for override in settings.set:
        words += ["--set", override]
    said: list[str] = []
    readings: dict[str, list[tuple[float, int]]] = {}
    with stalls.watched(folder / "stalls.txt", Config().realtime.priority):
        running = subprocess.Popen(
            [sys.executable, "-P", "-m", "tandem", *words],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert running.stderr is not None
        for line in running.stderr:
            said.append(line)
            if "the run begins" in line:
                break
        with (folder / "said.txt").open("w") as rest, Progress(console=console) as bar:
            # The run must not wait for a slow reader of its output.
            subprocess.Popen(["cat"], stdin=running.stderr, stdout=rest)
            task = bar.add_task(f"{settings.minutes:g} minutes at {settings.rate:g} Hz", total=seconds)
            began = time.monotonic()
            while running.poll() is None and time.monotonic() < began + seconds:
                elapsed = time.monotonic() - began
                bar.update(task, completed=elapsed)
                for name, rss in process_usage.resident(running.pid).items():
                    readings.setdefault(name, []).append((elapsed / 60.0, rss))
                due = settings.every * (elapsed // settings.every + 1)
                time.sleep(max(0.0, min(due - elapsed, seconds - elapsed)))
        out, _ = running.communicate()
    if running.returncode or not readings:
        console.print("".join(said)[-2000:] + (folder / "said.txt").read_text()[-2000:], markup=False)
        console.print(f"tandem run failed with exit code {running.returncode}", style="red")
        return None
    return {name: fit(values, settings.warm / 60.0) for name, values in readings.items()}, json.loads(out)


def fit(readings: list[tuple[float, int]], warm: float) -> Memory:
    """Return the slope after the first `warm` minutes, by least squares, and its confidence."""
    minutes, rss = [at for at, _ in readings], [value for _, value in readings]
    slope, uncertainty = _slope(minutes, rss, warm)
    half, _ = _slope(minutes, rss, max(warm, minutes[-1] / 2.0))
    return Memory(minutes, rss, slope, uncertainty, half)


def _slope(minutes: list[float], rss: list[int], since: float) -> tuple[float | None, float | None]:
    kept = [(at, value) for at, value in zip(minutes, rss, strict=True) if at >= since]
    if len(kept) < AT_LEAST:
        return None, None
    line = stats.linregress(*np.array(kept, dtype=float).T)
    wide = stats.t.ppf(0.5 + CONFIDENCE / 2.0, len(kept) - 2) * line.stderr
    # All readings are equal: the fit has no error, and scipy returns nan.
    return float(line.slope), float(np.nan_to_num(wide))


def late(parts: list[Path], noted: list[stalls.Stall], rate: float) -> Lateness:
    """Read the log once; the time of a tick is that of the state that it used."""
    period = 1.0 / rate
    ticks: set[int] = set()
    when: dict[int, tuple[float, float]] = {}
    suspects: dict[int, int] = {}
    for message in _timed(parts):
        if isinstance(message, m.Tick):
            ticks.add(message.seq)
            if message.state is not None:
                when[message.seq] = (message.state.t, message.lateness)
            if message.late or message.skipped:
                suspects[message.seq] = max(1, message.skipped)
        elif isinstance(message, m.TickTiming) and message.lateness_ms + message.tick_ms > period * 1e3:
            suspects.setdefault(message.seq, 1)
    excused = 0
    for seq, count in suspects.items():
        at, lateness = when.get(seq, (0.0, 0.0))
        excused += count * stalls.during(noted, at - count * period, at + lateness + period)
    longest = max((late for _, late in noted), default=0.0)
    return Lateness(len(ticks), sum(suspects.values()), excused, len(noted), longest * 1e3)


def _timed(parts: list[Path]) -> Iterator[m.Message]:
    """Return ticks and their timings; a tick in two parts appears twice."""
    names = {f"raw/{topic.name}": topic for topic in (topics.TICK, topics.TIMING)}
    for part in parts:
        channels: dict[int, topics.Topic] = {}
        encodings: dict[int, str] = {}
        for record in Scan(part):
            if isinstance(record, Channel) and record.topic in names:
                channels[record.id] = names[record.topic]
                encodings[record.id] = record.message_encoding
            if isinstance(record, Message) and record.channel_id in channels:
                yield codec.decode(
                    channels[record.channel_id],
                    raw_message.payload_of(encodings[record.channel_id], record.data),
                )


def replayed(parts: list[Path]) -> list[str]:
    """Return the outcome of a replay of each part, in a few words."""
    found = []
    for part in parts:
        try:
            result = replay(read_run(part))
        except LogError as error:
            found.append(f"{part.name}: {error}")
            continue
        verdict = "equal, byte for byte" if result.equal else f"differ, {result.differing_ticks}"
        lost = f", {result.lost_ticks} not in the log" * (result.lost_ticks > 0)
        found.append(f"ticks {result.first_tick} to {result.first_tick + result.ticks - 1} {verdict}{lost}")
    return found


def draw(memory: dict[str, Memory], warm: float, path: Path) -> None:
    """Plot the change of each process's memory since the first minute into a PNG."""
    figure = Figure(figsize=(8.0, 4.2), layout="constrained", dpi=120)
    ax = figure.subplots()
    for name, (colour, line) in LOOKS.items():
        if name not in memory:
            continue
        one = memory[name]
        at = next((i for i, minute in enumerate(one.minutes) if minute >= warm), 0)
        change = (np.array(one.rss) - one.rss[at]) / 1024.0
        label = f"{name}, {one.rss[at] / 1024:.0f} MB"
        ax.plot(one.minutes, change, color=colour, linestyle=line, linewidth=1.6, label=label)
    # The first minute loads many times more than what follows; the picture shows the rest.
    later = [
        (value - one.rss[at]) / 1024.0
        for one in memory.values()
        for at in [next((i for i, minute in enumerate(one.minutes) if minute >= warm), 0)]
        for value in one.rss[at:]
    ]
    room = 0.1 + 0.15 * (max(later) - min(later))
    ax.set_ylim(min(later) - room, max(later) + room)
    ax.axvspan(0.0, warm, color="0.93", zorder=0)
    ax.axhline(0.0, color="0.6", linewidth=0.8, zorder=0)
    ax.set_xlabel("minutes since the first command")
    ax.set_ylabel("MB more than after the first minute")
    ax.set_title("resident memory", loc="left", fontsize=10)
    ax.set_xlim(left=0.0)
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)
    figure.legend(loc="outside right upper", frameon=False, fontsize=9, title="after the first minute")
    figure.savefig(path)


def _table(
    memory: dict[str, Memory], lateness: Lateness, replays: list[str], run: dict[str, Any], picture: str
) -> list[str]:
    command = shlex.join(["python", "-m", "verification.soak", *sys.argv[1:]])
    lines = [
        *conditions(command),
        "",
        f"![Resident memory of every process over time]({picture})",
        "",
        "| process | MB after the first minute | MB at the end | slope, kB/min | in the second half |",
        "| --- | ---: | ---: | ---: | ---: |",
    ]
    for name in LOOKS:
        if name in memory:
            one = memory[name]
            at = next((i for i, minute in enumerate(one.minutes) if minute >= 1.0), 0)
            slope = "" if one.slope is None else f"{one.slope:+.1f} ± {one.uncertainty:.1f}"
            half = "" if one.second_half is None else f"{one.second_half:+.1f}"
            lines.append(
                f"| {name} | {one.rss[at] / 1024:.1f} | {one.rss[-1] / 1024:.1f} | {slope} | {half} |"
            )
    solve, tick = run.get("solve_ms"), run.get("tick_ms")
    return [
        *lines,
        "",
        "| lateness | |",
        "| --- | ---: |",
        f"| ticks | {lateness.ticks:,} |",
        f"| late or skipped | {lateness.late} |",
        f"| of these during a stall of the machine | {lateness.by_machine} |",
        f"| times that an empty loop above all of Tandem woke more than 2 ms late | {lateness.stalls} |",
        f"| longest stall | {lateness.longest_stall_ms:.1f} ms |",
        f"| solve, first part of the log: p50, p99, largest | {_spread(solve)} ms |",
        f"| tick, first part of the log: p50, p99, largest | {_spread(tick)} ms |",
        f"| constraint violations, first part of the log | {run.get('constraint_violations')} |",
        f"| ticks lost to the log, first part of the log | {run.get('lost_ticks')} |",
        "",
        f"Replay of the log's {len(replays)} parts:",
        "",
        *(f"- {part}" for part in replays),
    ]


def _spread(spread: dict[str, float] | None) -> str:
    return "-" if spread is None else ", ".join(f"{spread[name]:.2f}" for name in ("p50", "p99", "max"))


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Soak)))
