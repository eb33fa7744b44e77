"""Facts of a run without a fault."""

from __future__ import annotations

from typing import Any

import msgspec

from protocol import messages as m
from verification.faults.facts import Facts, Replayed
from verification.faults.processes.traced_plant import Sampled

CALM = Facts(
    violations=0,
    deepest=0.0,
    J=24.0,
    samples=200,
    ticks=200,
    late=0,
    late_by_machine=0,
    tick_p99_ms=5.0,
    sources=["command"],
    plan_s=0.0,
    safe_s=0.0,
    ready_after=None,
    control_after=0.0,
    burst=2,
    foreign_commands=0,
    foreign_states=0,
    samples_made=199,
    samples_held=199,
    readable_gap=None,
    log_missing=0,
    replay=Replayed("exact"),
    forged_adopted=0,
    rolled_back=0,
    errors=[1e-3] * 20 + [1e-4] * 20,
    fault_tick=20,
    view_at_end="recorder running writing run.mcap",
    log_time_off=0.0,
    verdicts={},
    counted={},
    said=[],
    extra={},
)


def seen(**changes: Any) -> Facts:
    return msgspec.structs.replace(CALM, **changes)


def sampled(source: str, t: float) -> Sampled:
    state = m.PlantState(
        run_id="plant-1",
        seq=0,
        t=t,
        x=[0.0],
        applied=[0.0],
        source=source,
        command_seq=0,
    )
    return Sampled(t, state)
