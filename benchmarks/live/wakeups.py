"""Punctuality of this machine: a loop that sleeps, wakes on its slot, and does nothing else.

    python -m benchmarks.live.wakeups --rate 1000 --seconds 10

A delay here affects every loop under the same load: a busy host takes the cores of a virtual machine away, and no
priority inside the machine helps. Compare a run's late ticks with this figure from the same time of day.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import tyro

from node_runtime.config.literals import AwakeMode
from node_runtime.config.sections import Config, RealtimeConfig
from node_runtime.realtime import clock
from node_runtime.realtime.pacer import Grid, Pacer
from node_runtime.realtime.scheduling import punctual


@dataclass(frozen=True)
class Wakeups:
    """Run the idle loop, with the priority and the slots of `tandem controller`."""

    rate: float = 1000.0
    """Slots a second."""
    seconds: float = 10.0
    priority: int = 50
    """SCHED_FIFO; 0: none."""
    late_fraction: float = 0.2
    """A slot is late if it begins later than this share of a period, as in the configuration."""
    awake: AwakeMode = "auto"
    """As `realtime.awake` in the configuration."""


def measure(settings: Wakeups) -> dict[str, Any]:
    """Late and skipped slots in percent of all, lateness in ms, and intervals without a punctual slot.

    The moments of `span` and `missed` are in seconds of Unix time.
    """
    period = 1.0 / settings.rate
    lateness: list[float] = []
    missed_at: list[tuple[float, float]] = []
    to_unix = time.time() - clock.now()
    config = Config(
        rate=settings.rate, realtime=RealtimeConfig(priority=settings.priority, awake=settings.awake)
    )
    with punctual(settings.priority, keep_awake=config.awake):
        pacer = Pacer(Grid(period, clock.now() + period), threading.Event())
        for _ in range(round(settings.seconds * settings.rate)):
            turn = pacer.next()
            assert turn is not None  # no other process stops it
            slot, late_by = turn
            lateness.append(late_by)
            if late_by > settings.late_fraction * period or slot.skipped:
                missed_at.append((slot.time - slot.skipped * period, slot.time + late_by))
        end = clock.now()
    late, skipped = np.array(lateness), pacer.grid.skipped
    missed = int((late > settings.late_fraction * period).sum()) + skipped
    p50, p99 = np.percentile(late * 1e3, [50, 99])
    return {
        "slots": len(late) + skipped,
        "off_percent": round(100.0 * missed / (len(late) + skipped), 3),
        "p50_ms": round(float(p50), 3),
        "p99_ms": round(float(p99), 3),
        "max_ms": round(float(late.max()) * 1e3, 3),
        "span": [end - settings.seconds + to_unix, end + to_unix],
        "missed": [[begin + to_unix, over + to_unix] for begin, over in missed_at],
    }


if __name__ == "__main__":
    sys.stdout.write(json.dumps(measure(tyro.cli(Wakeups))) + "\n")
