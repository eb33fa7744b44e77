"""Rows, and what a case comes to over its seeds and initial states."""

from __future__ import annotations

import math
import os
from typing import Any, NamedTuple

import msgspec
import numpy as np

from lbmpc.plants import Plant
from node_runtime import provenance
from run_log.reporting.summary import Spread
from tandem.experiments.study.declaration import Declaration, Resolved
from tandem.experiments.study.plan import RowPlan
from tandem.experiments.study.runner import Timing
from tandem.experiments.study.work import Record


class Row(msgspec.Struct, frozen=True, kw_only=True):
    """One run, as `summary.json` has it."""

    case: str
    group: str
    oracle: str
    seed: int
    x0: list[float]
    cost: float | None
    """Sum of the squared deviations of the performance states; null where the plant was lost."""
    regret: float | None
    """Cost above that of the true h from the same start; null where either was lost."""
    overshoot: float | None
    settling_step: int | None
    violations: int
    infeasible_ticks: int
    solve_ms: Spread | None
    """Of runs made alone, of the same oracle, horizon, network and rate."""
    lost: str | None
    weights_adopted: int
    error_first_second: float | None
    error_last_second: float | None


class CaseResult(NamedTuple):
    """All rows of one case, with the records behind them."""

    case: Resolved
    rows: list[Row]
    records: list[Record]
    timing: Timing | None

    def values(self, name: str) -> np.ndarray:
        """(rows,) one figure of each; what is lost is infinitely bad."""
        given = [getattr(row, name) for row in self.rows]
        return np.array([math.inf if value is None else value for value in given], dtype=float)

    def median(self, name: str) -> float:
        return float(np.median(self.values(name)))

    def worst(self, name: str) -> float:
        return float(self.values(name).max())

    @property
    def kept(self) -> float:
        """Share of the runs that keep all constraints on the true plant."""
        return float(np.mean([record.kept for record in self.records]))

    @property
    def oracle(self) -> str:
        return self.case.config.controller.oracle

    @property
    def label(self) -> str:
        return self.case.label


def collect(
    plans: list[RowPlan], records: dict[str, Record], timings: dict[str, Timing], plant: Plant
) -> list[CaseResult]:
    """In the order of the file."""
    cases: dict[str, CaseResult] = {}
    for plan in plans:
        case, record = plan.case, records[plan.job.key]
        floor, timing = records[plan.floor.key], timings.get(case.name)
        result = cases.setdefault(case.name, CaseResult(case, [], [], timing))
        result.rows.append(_row(plan, record, floor, timing, plant))
        result.records.append(record)
    return list(cases.values())


def _row(plan: RowPlan, record: Record, floor: Record, timing: Timing | None, plant: Plant) -> Row:
    config = plan.case.config
    x0 = plan.x0 or config.plant.x0 or plant.x0.tolist()
    known = record.cost is not None and floor.cost is not None
    return Row(
        case=plan.case.name,
        group=plan.case.group,
        oracle=config.controller.oracle,
        seed=plan.seed,
        x0=list(x0),
        cost=record.cost,
        regret=record.cost - floor.cost if known else None,  # type: ignore[operator]
        overshoot=record.overshoot,
        settling_step=record.settling_step,
        violations=record.violations,
        infeasible_ticks=record.infeasible_ticks,
        solve_ms=spread(timing) if timing else None,
        lost=record.lost,
        weights_adopted=record.weights_adopted,
        error_first_second=record.error_first,
        error_last_second=record.error_last,
    )


def spread(timing: Timing) -> Spread:
    times = np.concatenate(timing.runs)
    return Spread(float(np.percentile(times, 50)), float(np.percentile(times, 99)), float(times.max()))


def summary(
    declared: Declaration, rows: list[Row], plant: Plant, command: str, code: str, processes: int, quick: bool
) -> dict[str, Any]:
    """What `summary.json` holds."""
    return {
        "experiment": declared.name,
        "quick": quick,
        "plant": plant.name,
        "command": command,
        "code": code,
        "machine": provenance.describe(),
        "versions": provenance.versions(provenance.SCIENCE),
        "processes": processes,
        "cores": os.cpu_count(),
        "rows": rows,
    }
