"""Constructed records and results, without a run."""

from __future__ import annotations

from typing import Any

import msgspec

from run_log.reporting.performance import Performance
from tandem.experiments.study import results
from tandem.experiments.study.plan import Job, rows
from tandem.experiments.study.timing import Timing
from tandem.experiments.study.work import Record
from tests.tandem.experiments.small import PLANT, SHIPPED, cases

SHIPPED_CASES = cases(SHIPPED)
NETWORK = next(case for case in SHIPPED_CASES if case.name == "compressor: oracle = dnn")
NETWORK = msgspec.structs.replace(NETWORK, varied={}, words={})


def a_record(cost: float, overshoot: float = 0.0, violations: int = 0, **changes: Any) -> Record:
    job = Job(config=SHIPPED_CASES[0].config, steps=200, episodes=1, faults=SHIPPED_CASES[0].faults)
    found = Performance(
        J=cost,
        deviation=0.8 * cost,
        overshoot={"z": overshoot, "y": None},
        settled_s=5.0,
        settled_by_state_s={"z": 5.0, "y": 2.0},
        constraint_violations=violations,
        excess_between_samples=0.0,
    )
    record = Record(
        job=job,
        lost=None,
        episodes=[found],
        performance=found,
        iteration_limit_ticks=0,
        soft_ticks=0,
        fallback_ticks=0,
        weights_adopted=0,
        error_first=None,
        error_last=None,
        traces=None,
        lemma=None,
        arithmetic="a processor",
    )
    changed = msgspec.structs.replace(record, **changes)
    return (
        changed if "episodes" in changes else msgspec.structs.replace(changed, episodes=[changed.performance])
    )


def a_result(
    name: str,
    costs: list[float],
    overshoot: float = 0.0,
    violations: int = 0,
    oracle: str = "dnn",
    solve_ms: list[float] | None = None,
    **changes: Any,
) -> results.CaseResult:
    """A case whose runs have these J, with a floor of 20; `solve_ms`: of its timed run."""
    config = NETWORK.config
    config = msgspec.structs.replace(
        config, controller=msgspec.structs.replace(config.controller, oracle=oracle)
    )
    seeds = list(range(len(costs)))
    case = msgspec.structs.replace(NETWORK, name=name, label=name, seeds=seeds, config=config)
    plans = list(rows([case]))
    floor = a_record(20.0)
    records: dict[str, Record] = {plan.floor.key: floor for plan in plans}
    records |= {
        plan.job.key: a_record(cost, overshoot, violations, **changes)
        for plan, cost in zip(plans, costs, strict=True)
    }
    timings = {} if solve_ms is None else {name: Timing([solve_ms])}
    return results.collect(plans, records, timings, PLANT)[0]
