"""Figures, tables and pictures of the records of runs."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import msgspec
import numpy as np
import pytest

from run_log.reporting.performance import Performance
from tandem.experiments.reporting import pictures, tables
from tandem.experiments.reporting.chart_figure import chart_figure
from tandem.experiments.reporting.charts import Chart
from tandem.experiments.reporting.style import png
from tandem.experiments.study import results
from tandem.experiments.study.declaration import Picture
from tandem.experiments.study.plan import Job, rows
from tandem.experiments.study.work import Traces, read
from tests.helpers.plants.pendulum import PENDULUM
from tests.tandem.experiments.made import NETWORK, a_record, a_result
from tests.tandem.experiments.small import PLANT


def test_figures_of_several_episodes_are_those_with_a_memory() -> None:
    first, second, third = (a_record(J).performance for J in (30.0, 21.0, 23.0))
    job = msgspec.structs.replace(a_record(20.0).job, episodes=3)
    floor = [a_record(20.0).performance] * 3
    (row,) = collected(job, [first, second, third], floor).rows
    assert row.J_by_episode == [30.0, 21.0, 23.0]
    assert row.regret_by_episode == pytest.approx([0.5, 0.05, 0.15])
    assert (row.J, row.regret, row.deviation) == pytest.approx((22.0, 0.1, 0.8 * 22.0))
    # The plant was lost in the second episode: only the first is known.
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


def test_the_regret_by_episode_has_a_line_for_each_oracle_and_a_chart_for_all_else() -> None:
    job = msgspec.structs.replace(a_record(20.0).job, episodes=3)
    learns = collected(
        job, [a_record(J).performance for J in (30.0, 21.0, 19.9)], [a_record(20.0).performance] * 3
    )
    wrong = [
        learns._replace(case=msgspec.structs.replace(learns.case, words={"plant.truth": f"slope = {slope}"}))
        for slope in (1.4, 1.6)
    ]
    charts = [picture.drawn for picture in pictures.draw("episodes", wrong, PLANT, None)]
    assert [chart.title for chart in charts if isinstance(chart, Chart)] == ["slope = 1.4", "slope = 1.6"]
    (line,) = charts[0].lines
    assert list(line.x) == [1, 2, 3]
    assert list(line.y) == pytest.approx([50.0, 5.0, -0.5])


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
    table = tables.cases_table([settled, restless, lost], PLANT)
    cells = {column.name: column.cells for column in table.columns}
    assert cells["J"] == ["20.5", "20", "lost"]
    assert cells["settled (s)"] == ["5", "not settled", "lost"]
    assert cells["worst excess (%)"] == ["0.0", "–", "lost"]
    said = dict(tables.terms(PLANT))["settled"]
    assert "z within 0.02 and y within 0.02 of the equilibrium stay (4 % of the half-width)" in said


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
    said = " ".join(one.caption for one in drawn)
    said += " ".join(one.drawn.y_label for one in drawn if isinstance(one.drawn, Chart))
    if kind in ("trajectories", "states", "recovery"):
        assert "angle of the arm (rad)" in said
    for one in drawn:
        assert png(chart_figure(one.drawn) if isinstance(one.drawn, Chart) else one.drawn)
    assert "angle" in dict(tables.terms(plant))["overshoot"]


def test_a_record_that_lacks_a_requested_result_is_not_used(tmp_path: Path) -> None:
    path = tmp_path / "run.json"
    path.write_bytes(msgspec.json.encode(a_record(1.0, 0.0)))
    assert read(path, detail=False) is not None
    assert read(path, detail=True) is None
