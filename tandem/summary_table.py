"""The figures of a run as commands print them: one JSON object, or a table."""

from __future__ import annotations

from typing import Any

import msgspec
from rich.table import Column, Table
from rich.text import Text

from run_log.reporting.summary import ADDS, Summary

FOR_A_PERSON = ("skipped_slots",)
"""Figures of the table alone; programs may rely on all others, in `run` and `simulate` alike."""

MEANING = {
    "ticks": "control steps",
    "late_ticks": "began too late, or took longer than a period",
    "skipped_slots": "slots without a tick",
    "lost_ticks": "ticks that the recorder did not receive",
    "weights_adopted": "sets of hidden weights",
    "weights_refused": "sets of hidden weights",
    "weights_rolled_back": "adopted, then worse than the previous set",
    "iteration_limit_ticks": "the solver stopped before it had converged",
    "soft_ticks": "a soft state constraint was violated in the plan",
    "fallback_ticks": "input not from the solver",
    "unreached_ticks": "no steady state was found with the outputs at the reference",
    "sensor_faults": "sensor faults that the controller detected",
    "target_distance": "of the last target's outputs from the reference, share of half-widths",
    "J_by_episode": "by start of the plant; the figures below are their mean or the worst",
    "J": "sum of the stage costs, Q and R per second, relative to the set-points or to x_e, u_e",
    "deviation": "integral of the performance states' squared deviations",
    "overshoot": "share of the state's own initial deviation",
    "settled_s": "all performance states within 4 % of their half-widths",
    "settled_by_state_s": "by state",
    "constraint_violations": "at samples: true state or applied input outside X or U",
    "violated_rows": "violations by constraint row",
    "excess_between_samples": "largest distance of the true motion from X, share of a half-width",
    "offset": "mean error of the outputs in the last second, share of half-widths",
    "solve_ms": "p50 / p99 / max",
    "tick_ms": "p50 / p99 / max",
    "prediction_error": "first / last second, or period if longer",
    "weight": "mean weight of the network in the prediction, last second",
    "constant_weight": "mean weight of the constant beside it",
    "noise": "estimated standard deviation of the measurement noise",
    "outside_ticks": "ticks outside the certified sets",
    "smallest_set_margin": "distance to their boundary, share of X's half-widths",
    "log": "",
}
ABSENT = {"settled_s": "not settled", "excess_between_samples": "unknown"}
"""Meaning of null, if it is more than a missing figure."""
OF_EACH_STATE = {
    "overshoot": "share",
    "settled_by_state_s": "settled_s",
    "offset": "share",
    "weight": "share",
    "constant_weight": "share",
    "noise": "",
}
"""States to which these figures of each performance state belong."""
WHERE_THERE_IS_ONE = (
    "unreached_ticks",
    "violated_rows",
    "target_distance",
    "offset",
    "sensor_faults",
    "weight",
    "constant_weight",
    "noise",
)
"""Rows that appear only where they apply: with a reference, an estimator, or such a fault."""
# Any value but zero is highlighted.
SHOULD_BE_ZERO = (
    "late_ticks",
    "skipped_slots",
    "lost_ticks",
    "weights_refused",
    "weights_rolled_back",
    "iteration_limit_ticks",
    "soft_ticks",
    "fallback_ticks",
    "constraint_violations",
    "excess_between_samples",
    "outside_ticks",
    "sensor_faults",
)


def of(summary: Summary) -> dict[str, Any]:
    """Return the object that `--json` prints."""
    return {key: value for key, value in msgspec.to_builtins(summary).items() if key not in FOR_A_PERSON}


def table(summary: Summary) -> Table:
    """Return the same as a table, with explanations."""
    columns = Column(style="bold"), Column(justify="right"), Column(style="dim")
    shown = Table(*columns, show_header=False, box=None, pad_edge=False, padding=(0, 2, 0, 0))
    figures = msgspec.to_builtins(summary)
    episodes = figures.pop("episodes")
    if len(episodes) > 1:
        figures = {"J_by_episode": {str(i): one["J"] for i, one in enumerate(episodes)}} | figures
    for name, value in figures.items():
        if name in WHERE_THERE_IS_ONE and value in (None, {}, []):
            continue
        style = "bold red" if name in SHOULD_BE_ZERO and value else ""
        shown.add_row(name, Text(_text(name, value), style), MEANING.get(name, ""))
    counted = [*(summary.weight or {}).values(), *(summary.constant_weight or {}).values()]
    if counted and max(counted) < ADDS:
        shown.add_row("learning", Text("adds nothing", "bold yellow"), "noise exceeds h")
    return shown


def _text(name: str, value: Any) -> str:
    if value is None:
        return ABSENT.get(name, "-")
    if name in OF_EACH_STATE:
        return ", ".join(f"{state} {_text(OF_EACH_STATE[name], one)}" for state, one in value.items())
    if isinstance(value, list):
        return "\n".join(value)
    if isinstance(value, dict):
        return " / ".join(_text("", part) for part in value.values())
    if name == "share":
        return f"{value:.1%}"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
