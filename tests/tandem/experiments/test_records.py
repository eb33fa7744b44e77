"""What is made of the records of runs: figures, words, tables and pictures."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from run_log.reporting.performance import Performance
from tandem.experiments.reporting import findings, pictures
from tandem.experiments.reporting.page import _table
from tandem.experiments.study import results
from tandem.experiments.study.declaration import Picture
from tandem.experiments.study.plan import Job, rows
from tandem.experiments.study.work import Record, Traces, read
from tests.helpers.plants.pendulum import PENDULUM
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
    name: str, costs: list[float], overshoot: float = 0.0, violations: int = 0, **changes: Any
) -> results.CaseResult:
    """With a floor of 20."""
    case = msgspec.structs.replace(NETWORK, name=name, label=name, seeds=list(range(len(costs))))
    plans = list(rows([case]))
    floor = a_record(20.0)
    records: dict[str, Record] = {plan.floor.key: floor for plan in plans}
    records |= {
        plan.job.key: a_record(cost, overshoot, violations, **changes)
        for plan, cost in zip(plans, costs, strict=True)
    }
    return results.collect(plans, records, {}, PLANT)[0]


def test_words_follow_from_the_figures() -> None:
    base = a_result("base", [21.0, 21.1, 21.2, 21.3])
    worse, same = a_result("worse", [22.0, 22.1, 22.2, 22.3]), a_result("same", [21.3, 21.2, 21.0, 21.1])
    breaks = a_result("breaks", [21.0, 21.1, 21.2, 21.3], violations=3)
    said = findings.compare([base, worse, same, breaks], "base")
    assert said[0] == "Matters, against base: worse, breaks."
    assert said[1] == "No clear difference from base: same."
    assert "more J, 22.1 against 21.1 in the median in all 4 pairs" in said[2]
    assert "keeps all constraints at samples in 0 of 4 runs, against 4 of 4 runs" in said[3]


def test_regret_is_signed_and_the_page_names_cases_below_the_true_h() -> None:
    better, worse = a_result("better", [19.0, 23.0]), a_result("worse", [20.0, 21.0])
    assert better.values("regret") == pytest.approx([-0.05, 0.15])
    (said,) = findings.below_perfect([better, worse])
    assert said.startswith("J below that of the true h: better in 1 of 2 runs, by up to 5.0%.")
    assert findings.below_perfect([worse]) == []


def test_figures_of_several_episodes_are_those_with_a_memory() -> None:
    first, second, third = (a_record(J).performance for J in (30.0, 21.0, 23.0))
    job = msgspec.structs.replace(a_record(20.0).job, episodes=3)
    floor = [a_record(20.0).performance] * 3
    (row,) = collected(job, [first, second, third], floor).rows
    assert row.J_by_episode == [30.0, 21.0, 23.0]
    assert row.regret_by_episode == pytest.approx([0.5, 0.05, 0.15])
    assert (row.J, row.regret, row.deviation) == pytest.approx((22.0, 0.1, 0.8 * 22.0))
    # Lost in the second episode: only the first one is known.
    (row,) = collected(job, [first], floor, lost="at step 3 of 200 in episode 2 of 3").rows
    assert row.J_by_episode == [30.0, None, None]
    assert (row.J, row.regret, row.J_first) == (None, None, 30.0)


def collected(
    job: Job, episodes: list[Performance], floor: list[Performance], lost: str | None = None
) -> results.CaseResult:
    (plan,) = rows([msgspec.structs.replace(NETWORK, episodes=job.episodes, seeds=[0])])
    records = {
        plan.floor.key: a_record(20.0, job=job, episodes=floor),
        plan.job.key: a_record(20.0, job=job, episodes=episodes, lost=lost),
    }
    return results.collect([plan], records, {}, PLANT)[0]


def test_the_picture_of_episodes_has_a_line_for_each_oracle_and_a_panel_for_all_else() -> None:
    job = msgspec.structs.replace(a_record(20.0).job, episodes=3)
    learns = collected(
        job, [a_record(J).performance for J in (30.0, 21.0, 19.9)], [a_record(20.0).performance] * 3
    )
    wrong = [
        learns._replace(case=msgspec.structs.replace(learns.case, words={"plant.truth": f"slope = {slope}"}))
        for slope in (1.4, 1.6)
    ]
    (picture,) = pictures.draw("episodes", wrong, PLANT, None)
    assert [ax.get_title() for ax in picture.figure.axes if ax.get_visible()] == [
        "slope = 1.4",
        "slope = 1.6",
    ]
    line = picture.figure.axes[0].lines[0]
    assert list(line.get_xdata()) == [1, 2, 3]
    assert list(line.get_ydata()) == pytest.approx([50.0, 5.0, -0.5])
    low, high = picture.figure.axes[0].get_ylim()
    assert low < -0.5
    assert high > 50.0


def test_lost_unsettled_and_unknown_are_distinguished() -> None:
    settled = a_result("fine", [20.0, 21.0], overshoot=0.1)
    assert settled.median("overshoot") == pytest.approx(0.1)
    assert settled.median("settled_s") == 5.0
    performance = msgspec.structs.replace(
        a_record(20.0).performance, settled_s=None, excess_between_samples=None, overshoot={"z": None}
    )
    restless = a_result("restless", [20.0, 20.0], performance=performance)
    lost = a_result("lost", [20.0, 20.0], lost="at step 3")
    assert np.isnan(restless.worst("excess_between_samples"))
    assert np.isnan(restless.median("overshoot"))
    assert np.isinf(lost.worst("J"))
    table = _table([settled, restless, lost], PLANT)
    column = {name: i for i, name in enumerate(table.head)}
    shown = [
        [row[column[name]] for name in ("J", "settled (s)", "excess, also between samples (%)")]
        for row in table.body
    ]
    assert shown == [["20.5", "5", "0.0"], ["20", "not settled", "–"], ["lost", "lost", "lost"]]
    assert "z within 0.02 and y within 0.02 of the equilibrium (4% of the half-width)" in table.note


@pytest.mark.parametrize("states", [1, 2])
@pytest.mark.parametrize("kind", ["trajectories", "states", "survival", "recovery", "rows", "episodes"])
def test_a_plant_with_one_performance_state_has_every_picture(kind: Picture, states: int) -> None:
    plant = dataclasses.replace(
        PENDULUM,
        **{name: getattr(PENDULUM, name)[:states] for name in ("states", "x_e", "x_min", "x_max", "x0")},
        names={"angle": "angle of the arm"},
    )
    traces = Traces(x=[[0.5], [0.2], [0.0]], u=[[1.0], [0.0]], error=[None, 0.1])
    case = msgspec.structs.replace(NETWORK, x0s=[[0.5, 0.0][:states]], seeds=[0])
    plans = list(rows([case]))
    performance = msgspec.structs.replace(
        a_record(1.0).performance, overshoot={"angle": 0.1}, settled_by_state_s={"angle": 5.0}
    )
    record = a_record(1.0, performance=performance, traces=traces)
    records = {job.key: record for plan in plans for job in (plan.job, plan.floor)}
    found = results.collect(plans, records, {}, plant)
    drawn = pictures.draw(kind, found, plant, None)
    assert drawn
    labels = {ax.get_xlabel() for one in drawn for ax in one.figure.axes}
    labels |= {ax.get_ylabel() for one in drawn for ax in one.figure.axes}
    if kind in ("trajectories", "states", "recovery"):
        assert "angle of the arm (rad)" in labels
    assert "angle" in _table(found, plant).note


def test_a_record_that_lacks_a_requested_result_is_not_used(tmp_path: Path) -> None:
    path = tmp_path / "run.json"
    path.write_bytes(msgspec.json.encode(a_record(1.0, 0.0)))
    assert read(path, detail=False) is not None
    assert read(path, detail=True) is None
