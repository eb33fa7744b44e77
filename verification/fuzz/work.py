"""The work of one process of the fuzzer."""

from __future__ import annotations

import faulthandler
import hashlib
import logging
import os
import random
import time
import traceback
from collections.abc import Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

import msgspec

from verification.fuzz.targets import targets

HANG_S = 20.0
"""Seconds. A thousand payloads take some ten milliseconds; a reader that takes this long hangs."""
BLOCK = 1000
REPORT_EVERY = 20
"""Blocks."""
KEPT = 20
STATM = Path("/proc/self/statm")


class Finding(msgspec.Struct, frozen=True):
    """A payload that was neither accepted nor refused as declared."""

    target: str
    error: str
    payload: bytes

    @property
    def digest(self) -> str:
        return hashlib.sha256(self.payload).hexdigest()


class Figures(msgspec.Struct):
    """Of one reader."""

    kinds: dict[str, int] = {}
    """How often each answer."""
    slowest_ns: int = 0
    crashed: int = 0


class Report(msgspec.Struct):
    """Figures of one process, so far."""

    payloads: int = 0
    seconds: float = 0.0
    found: dict[str, Figures] = {}
    rss_kb: list[int] = []
    findings: list[Finding] = []
    ended: bool = False


@dataclass(frozen=True)
class Work:
    """Process a share of the payloads."""

    payloads: int
    seed: int
    folder: str

    def run(self, to: Connection) -> None:
        """Report at intervals to the parent process; a hang ends with a traceback."""
        logging.disable()
        report = Report()
        known = targets(self.seed, Path(self.folder))
        rng = random.Random(self.seed)
        chosen = rng.choices(known, [target.weight for target in known], k=50_021)
        began, turn = time.perf_counter(), 0
        for block in range(-(-self.payloads // BLOCK)):
            faulthandler.dump_traceback_later(HANG_S, exit=True)
            for _ in range(min(BLOCK, self.payloads - block * BLOCK)):
                target = chosen[turn % len(chosen)]
                turn += 1
                figures = report.found.setdefault(target.name, Figures())
                payload = target.make()
                before = time.perf_counter_ns()
                try:
                    kind = target.read(payload)
                except Exception as error:  # noqa: BLE001 - any other exception is a finding
                    figures.crashed += 1
                    if len(report.findings) < KEPT:
                        place = traceback.extract_tb(error.__traceback__)[-1]
                        text = f"{type(error).__name__}: {error} ({Path(place.filename).name}:{place.lineno})"
                        report.findings.append(Finding(target.name, text[:300], payload))
                    continue
                figures.slowest_ns = max(figures.slowest_ns, time.perf_counter_ns() - before)
                figures.kinds[kind] = figures.kinds.get(kind, 0) + 1
            faulthandler.cancel_dump_traceback_later()
            if block % REPORT_EVERY == 0:
                self._say(report, turn, began, to)
        report.ended = True
        self._say(report, turn, began, to)
        to.close()

    def _say(self, report: Report, turn: int, began: float, to: Connection) -> None:
        report.payloads, report.seconds = turn, time.perf_counter() - began
        if STATM.exists():
            report.rss_kb.append(int(STATM.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") // 1024)
        to.send_bytes(msgspec.json.encode(report))


def merge(reports: Sequence[Report]) -> dict[str, Figures]:
    """The figures of all processes together."""
    merged: dict[str, Figures] = {}
    for report in reports:
        for name, figures in report.found.items():
            into = merged.setdefault(name, Figures())
            into.slowest_ns = max(into.slowest_ns, figures.slowest_ns)
            into.crashed += figures.crashed
            for kind, count in figures.kinds.items():
                into.kinds[kind] = into.kinds.get(kind, 0) + count
    return merged
