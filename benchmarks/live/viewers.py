"""Tick times with and without a live view, in turns within one run.

    python -m benchmarks.live.viewers --rate 20

One `tandem run` goes on all the time. In turns `tandem live` runs beside it with viewers that read everything, and does
not run. The first seconds of each turn are not counted: a process that starts takes a core for a while.
"""

from __future__ import annotations

import asyncio
import json
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import tyro
from websockets.asyncio.client import connect
from websockets.typing import Subprotocol

from benchmarks.live.ports import free_port
from node_runtime import provenance
from protocol import topics
from run_log.reading.reader import read_run

SETTLE_S = 5.0
"""Seconds at the beginning of a turn that are not counted."""
FIGURES = ("tick_ms", "solve_ms", "lateness_ms")


@dataclass(frozen=True)
class Viewers:
    """Length of the measurement, and number of viewers."""

    rate: float = 20.0
    """Samples a second."""
    turns: int = 6
    """Number of turns with a view, and of turns without."""
    seconds: float = 15.0
    """Seconds of each turn that are counted."""
    viewers: int = 1
    set: list[str] = field(default_factory=list)
    """More section.key=value for `tandem run`."""


def main(settings: Viewers) -> int:
    """Measure, and print a Markdown table."""
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "run.mcap"
        turns = list(_alternate(settings, log))
        found = _by_turn(log, turns)
    facts = provenance.describe()
    print_line(
        f"{facts['processor']}, {facts['cores']} cores, {settings.rate:g} Hz, {settings.turns} turns of "
        f"{settings.seconds:g} s each, {settings.viewers} viewers, load {provenance.load():.1f}."
    )
    print_line("")
    print_line(
        "| figure, ms | without: p50 / p99 | with: p50 / p99 | difference of p50 in pairs: median, range |"
    )
    print_line("| --- | ---: | ---: | ---: |")
    for name in FIGURES:
        print_line(_row(name, found))
    return 0


def print_line(text: str) -> None:
    """One line of the result, at once."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def _alternate(settings: Viewers, log: Path) -> Iterator[tuple[bool, float, float]]:
    """Run, and yield (viewed, begin, end) in Unix seconds of what is counted of each turn."""
    endpoint, port = f"tcp/127.0.0.1:{free_port()}", free_port()
    there = [f"bus.endpoint={endpoint}", f"live.port={port}", f"rate={settings.rate:g}", *settings.set]
    options = [word for one in there for word in ("--set", one)]
    arguments = ["--seconds", "100000", "--log", str(log), *options]
    with _tandem("run", *arguments) as run:
        assert run.stdout is not None
        while b"the first command" not in (line := run.stdout.readline()):
            if not line:
                raise RuntimeError("the run ended before its first command")
        for turn in range(2 * settings.turns):
            viewed = turn % 2 == 1
            with _tandem("live", *options) if viewed else nullcontext():
                if viewed:
                    _await_port(port)
                time.sleep(SETTLE_S)
                begin = time.time()
                if viewed:
                    asyncio.run(_look(port, settings))
                else:
                    time.sleep(settings.seconds)
                end = time.time()
            yield viewed, begin, end


@contextmanager
def _tandem(*arguments: str) -> Iterator[subprocess.Popen[bytes]]:
    """Run a tandem command until the block ends."""
    command = [sys.executable, "-P", "-m", "tandem", *arguments]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    try:
        yield process
    finally:
        process.terminate()
        process.wait()


def _await_port(port: int) -> None:
    """Wait until the server answers."""
    while True:
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                return
        time.sleep(0.1)


async def _look(port: int, settings: Viewers) -> None:
    await asyncio.gather(*(_view(port, settings.seconds) for _ in range(settings.viewers)))


async def _view(port: int, seconds: float) -> None:
    """Subscribe to everything, and read for so long."""
    at = f"ws://localhost:{port}"
    async with connect(at, subprotocols=[Subprotocol("foxglove.sdk.v1")]) as client:
        try:
            async with asyncio.timeout(seconds):
                async for frame in client:
                    if isinstance(frame, str) and (word := json.loads(frame))["op"] == "advertise":
                        asked = [{"id": one["id"], "channelId": one["id"]} for one in word["channels"]]
                        await client.send(json.dumps({"op": "subscribe", "subscriptions": asked}))
        except TimeoutError:
            pass


def _by_turn(log: Path, turns: list[tuple[bool, float, float]]) -> list[tuple[bool, dict[str, np.ndarray]]]:
    entries = read_run(log).entries(topics.TIMING)
    at = np.array([entry.log_time for entry in entries]) * 1e-9
    columns = {name: np.array([getattr(entry.message, name) for entry in entries]) for name in FIGURES}
    return [
        (viewed, {name: column[(at >= begin) & (at < end)] for name, column in columns.items()})
        for viewed, begin, end in turns
    ]


def _row(name: str, found: list[tuple[bool, dict[str, np.ndarray]]]) -> str:
    turns = {kind: [part[name] for viewed, part in found if viewed == kind] for kind in (False, True)}
    cells = []
    for parts in turns.values():
        p50, p99 = np.percentile(np.concatenate(parts), [50.0, 99.0])
        cells.append(f"{p50:.3f} / {p99:.3f}")
    pairs = [np.median(after) - np.median(before) for before, after in zip(*turns.values(), strict=True)]
    cells.append(f"{np.median(pairs):+.3f}, {min(pairs):+.3f} to {max(pairs):+.3f}")
    return f"| {name} | {' | '.join(cells)} |"


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Viewers)))
