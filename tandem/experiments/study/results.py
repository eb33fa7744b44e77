"""Rows of the results, and the figures of a case over its seeds and initial states."""

from __future__ import annotations

import math
from collections import Counter
from typing import Any, NamedTuple

import msgspec
import numpy as np

from lbmpc.plants import Description
from node_runtime import provenance
from run_log.reporting.performance import of_episodes
from run_log.reporting.summary import Spread
from tandem.experiments.study.declaration import Declaration, Resolved
from tandem.experiments.study.isolated import Failure
from tandem.experiments.study.plan import RowPlan
from tandem.experiments.study.runner import RunnerError
from tandem.experiments.study.timing import Timing
from tandem.experiments.study.work import Record


class Row(msgspec.Struct, frozen=True, kw_only=True):
    """One run in `summary.json`.

    With several episodes, J, regret, deviation, overshoot and settling cover those from the second one on, which show
    the effect of the memory. J and the deviation are means, overshoot and settling the worst values.
    """

    case: str
    group: str
    oracle: str
    seed: int
    x0: list[float]
    J: float | None
    """Sum of the stage costs, Q and R as densities; null if the plant was lost, as are the next five."""
    regret: float | None
    """Difference of J to that of the true h from the same start, as a share of it; null if either plant was lost."""
    deviation: float | None
    """Integral of the summed squared deviations of the performance states, plant units squared times seconds."""
    J_by_episode: list[float | None]
    regret_by_episode: list[float | None]
    """J and regret of each episode; null if the plant was lost before its end."""
    overshoot: dict[str, float | None] | None
    """Overshoot of each performance state, as a share of its initial deviation; null for one that began settled."""
    settled_s: float | None
    """Settling time in seconds; null if not settled at the end."""
    settled_by_state_s: dict[str, float | None] | None
    violations: int
    """Samples outside X or U by more than 1e-6 of a half-width."""
    excess_between_samples: float | None
    """Largest distance from X, as a share of a half-width; null if the motion between samples is not known."""
    iteration_limit_ticks: int
    soft_ticks: int
    fallback_ticks: int
    solve_ms: Spread | None
    """Solve times of runs made alone, with the same oracle, horizon, network and rate."""
    lost: str | None
    weights_adopted: int
    error_first_second: float | None
    error_last_second: float | None
    arithmetic: str
    """Processor, BLAS kernels and compiler of the machine of the run, on which its last digits depend."""

    @property
    def J_first(self) -> float | None:
        return self.J_by_episode[0]

    @property
    def regret_first(self) -> float | None:
        return self.regret_by_episode[0]


class FailedRun(msgspec.Struct, frozen=True, kw_only=True):
    """A run that has no row, or whose regret is not known because the run with the true h failed."""

    case: str
    group: str
    seed: int
    x0: list[float] | None
    floor: bool
    """Whether the failed run is that with the true h from the same start."""
    failure: Failure


def failed(plans: list[RowPlan], failures: dict[str, Failure]) -> list[FailedRun]:
    """Return the failed runs in the order of the file, each once."""
    found: dict[str, FailedRun] = {}
    for plan in plans:
        for job, floor in ((plan.job, False), (plan.floor, True)):
            if job.key in failures and job.key not in found:
                found[job.key] = FailedRun(
                    case=plan.case.name,
                    group=plan.case.group,
                    seed=plan.seed,
                    x0=plan.x0,
                    floor=floor,
                    failure=failures[job.key],
                )
    return list(found.values())


def with_results(
    cases: list[Resolved], plans: list[RowPlan], records: dict[str, Record], failed: list[FailedRun]
) -> list[Resolved]:
    """Return the cases with at least one run. Raises `RunnerError` if there is none."""
    made = {plan.case.name for plan in plans if plan.job.key in records}
    if not made:
        first = failed[0]
        raise RunnerError(
            f"every run failed; the first of {len(failed)}, case {first.case!r}, seed {first.seed}: "
            f"{first.failure.text}\n{first.failure.traceback}".rstrip()
        )
    return [case for case in cases if case.name in made]


class CaseResult(NamedTuple):
    """All rows of one case, with the records behind them."""

    case: Resolved
    rows: list[Row]
    records: list[Record]
    timing: Timing | None

    def values(self, name: str) -> np.ndarray:
        """Return one figure of every row, (rows,); for figures by state, that of the first performance state.

        A lost or unsettled run counts as infinite. A missing figure is NaN, such as the overshoot of a state that began
        settled.
        """
        return np.array([_value(row, name) for row in self.rows])

    def median(self, name: str) -> float:
        """Return the median over the rows with this figure; NaN if none has it."""
        values = self.values(name)
        values = values[~np.isnan(values)]
        return float(np.median(values)) if values.size else math.nan

    def worst(self, name: str) -> float:
        values = self.values(name)
        values = values[~np.isnan(values)]
        return float(values.max()) if values.size else math.nan

    @property
    def kept(self) -> float:
        """Return the share of runs that keep all constraints of the true plant at samples."""
        return float(np.mean([record.kept for record in self.records]))

    @property
    def oracle(self) -> str:
        return self.case.config.controller.oracle

    @property
    def label(self) -> str:
        return self.case.label


def _value(row: Row, name: str) -> float:
    value = getattr(row, name)
    if isinstance(value, dict):
        value = next(iter(value.values()))
    if value is not None:
        return float(value)
    return math.inf if row.lost is not None or name == "settled_s" else math.nan


def collect(
    plans: list[RowPlan], records: dict[str, Record], timings: dict[str, Timing], plant: Description
) -> list[CaseResult]:
    """Return the rows in the order of the file, without failed runs."""
    cases: dict[str, CaseResult] = {}
    for plan in plans:
        case, record = plan.case, records.get(plan.job.key)
        floor, timing = records.get(plan.floor.key), timings.get(case.name)
        if record is None:
            continue
        result = cases.setdefault(case.name, CaseResult(case, [], [], timing))
        result.rows.append(_row(plan, record, floor, timing, plant))
        result.records.append(record)
    return list(cases.values())


def _row(
    plan: RowPlan, record: Record, floor: Record | None, timing: Timing | None, plant: Description
) -> Row:
    config = plan.case.config
    x0 = plan.x0 or config.plant.x0 or plant.x0.tolist()
    found, floors = _figures(record), _figures(floor) if floor else {}
    J = _J_by_episode(record)
    least = _J_by_episode(floor) if floor else [None] * len(J)
    return Row(
        case=plan.case.name,
        group=plan.case.group,
        oracle=config.controller.oracle,
        seed=plan.seed,
        x0=list(x0),
        J=found.get("J"),
        regret=_regret(found.get("J"), floors.get("J")),
        deviation=found.get("deviation"),
        J_by_episode=J,
        regret_by_episode=[_regret(own, its) for own, its in zip(J, least, strict=True)],
        overshoot=found.get("overshoot"),
        settled_s=found.get("settled_s"),
        settled_by_state_s=found.get("settled_by_state_s"),
        violations=record.performance.constraint_violations,
        excess_between_samples=record.performance.excess_between_samples if found else None,
        iteration_limit_ticks=record.iteration_limit_ticks,
        soft_ticks=record.soft_ticks,
        fallback_ticks=record.fallback_ticks,
        solve_ms=spread(timing) if timing else None,
        lost=record.lost,
        weights_adopted=record.weights_adopted,
        error_first_second=record.error_first,
        error_last_second=record.error_last,
        arithmetic=record.arithmetic,
    )


def _figures(record: Record) -> dict[str, Any]:
    """Return the figures of the episodes from the second one on, or of the only one; empty if the plant was lost."""
    if record.lost is not None:
        return {}
    return msgspec.structs.asdict(of_episodes(record.episodes[1:] or record.episodes))


def _J_by_episode(record: Record) -> list[float | None]:
    return [*(one.J for one in record.episodes), *[None] * (record.job.episodes - len(record.episodes))]


def _regret(J: float | None, floor: float | None) -> float | None:
    return None if J is None or not floor else J / floor - 1.0


def spread(timing: Timing) -> Spread:
    times = np.concatenate(timing.runs)
    return Spread(float(np.percentile(times, 50)), float(np.percentile(times, 99)), float(times.max()))


def summary(
    declared: Declaration,
    rows: list[Row],
    failed: list[FailedRun],
    timings: dict[str, Timing],
    plant: Description,
    command: str,
    code: str,
    quick: bool,
) -> dict[str, Any]:
    """Return the content of `summary.json`."""
    return {
        "experiment": declared.name,
        "quick": quick,
        "plant": plant.name,
        "command": command,
        "code": code,
        "machine": provenance.describe(),
        "versions": provenance.versions(provenance.SCIENCE),
        "arithmetic": Counter(row.arithmetic for row in rows),
        "solve_ms_measured_on": sorted({timing.processor for timing in timings.values()}),
        "rows": rows,
        "failed": failed,
    }
