"""The figures of a run as commands give them: one JSON object, or a table."""

from __future__ import annotations

from typing import Any

import msgspec
from rich.table import Column, Table
from rich.text import Text

from run_log.reporting.summary import Summary

FOR_A_PERSON = ("skipped_slots", "final_deviation")
"""Shown in the table alone; programs may count on everything else, in `run` and `simulate` alike."""

MEANING = {
    "ticks": "control steps",
    "late_ticks": "began later than they may",
    "skipped_slots": "slots without a tick",
    "lost_ticks": "never reached the recorder",
    "weights_adopted": "sets of hidden weights",
    "weights_refused": "sets of hidden weights",
    "weights_rolled_back": "adopted, then worse than the set before",
    "fallback_ticks": "input not from the solver",
    "soft_ticks": "a soft state constraint gave way",
    "constraint_violations": "true state at a sample or applied input outside X or U",
    "cost": "sum of squared deviations",
    "overshoot": "of the first performance state",
    "settling_step": "last one off by more than 0.02",
    "final_deviation": "largest, of the performance states",
    "solve_ms": "p50 / p99 / max",
    "tick_ms": "p50 / p99 / max",
    "prediction_error": "first / last second",
    "outside_ticks": "outside of the certified sets",
    "smallest_set_margin": "to their boundary, of X's half-widths",
    "log": "",
}
# Anything but zero is worth a look.
SHOULD_BE_ZERO = (
    "late_ticks",
    "skipped_slots",
    "lost_ticks",
    "weights_refused",
    "weights_rolled_back",
    "fallback_ticks",
    "constraint_violations",
    "outside_ticks",
)


def of(summary: Summary) -> dict[str, Any]:
    """The object that `--json` prints."""
    return {key: value for key, value in msgspec.to_builtins(summary).items() if key not in FOR_A_PERSON}


def table(summary: Summary) -> Table:
    """The same for a person, with what else there is to know."""
    columns = Column(style="bold"), Column(justify="right"), Column(style="dim")
    shown = Table(*columns, show_header=False, box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for name, value in msgspec.to_builtins(summary).items():
        style = "bold red" if name in SHOULD_BE_ZERO and value else ""
        shown.add_row(name, Text(_text(value), style), MEANING.get(name, ""))
    return shown


def _text(value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, dict):
        return " / ".join(_text(part) for part in value.values())
    return f"{value:.4g}" if isinstance(value, float) else str(value)
