"""Periodic set-points: the references, the equilibria of the true plant, and the cost of a cycle."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest

from lbmpc.plants import PlantError, true_motion
from node_runtime.config.strict import ConfigError
from tandem.experiments.simulation import wave
from tandem.experiments.study.plan import Job, rows
from tandem.experiments.study.work import Record, Task, work
from tests.tandem.experiments.small import PLANT, SHIPPED, cases

TRUE = PLANT.varied(slope=1.4)
STEPS, CYCLES = 24, 2
WAVE = f"""
name = "wave"
title = "A wave"
steps = {STEPS}
episodes = {CYCLES}
set_points = {{ y = [1.65, 1.7] }}
[set]
controller = {{ horizon = 15, solver = {{ compile = "never" }}, Q = [1.0, 1.0, 1e-3, 1e-5], R = [0.1] }}
plant = {{ truth = {{ slope = 1.4 }}, x0 = [0.4, 1.6, 1.1547, 0.0] }}
[[group]]
name = "g"
title = "g"
[[case]]
name = "wave"
group = "g"
vary."controller.oracle" = ["perfect", "linear"]
"""


def test_a_wave_has_one_cycle_more_than_is_counted() -> None:
    asked = wave.reference({"y": [1.65, 1.75]}, 10.0, 1)
    assert asked.times == [0.0, 5.0, 5.0, 10.0, 10.0, 15.0, 15.0, 20.0]
    assert asked.values == [[1.65], [1.65], [1.75], [1.75]] * 2


def record_of(job: Job) -> Record:
    done = work(Task(job=job, detail=True, log=False, files={}))
    return msgspec.json.decode(done.record, type=Record)


def test_a_rest_is_one_of_the_true_plant_with_the_outputs_there() -> None:
    x, u = wave.rests({"y": [1.65, 1.75]}, 4, true_motion(TRUE), PLANT, 0.05)
    assert x[:, 1] == pytest.approx([1.65, 1.65, 1.75, 1.75])
    for at, under in zip(x, u, strict=True):
        assert true_motion(TRUE).step(at, under, 0.05) == pytest.approx(at, abs=1e-9)
    assert np.abs(true_motion(PLANT).step(x[0], u[0], 0.05) - x[0]).max() > 1e-4
    with pytest.raises(PlantError):
        wave.rests({"rdot": [1.0]}, 4, true_motion(TRUE), PLANT, 0.05)


def test_values_where_the_true_plant_has_no_rest_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "wave.toml"
    path.write_text(WAVE.replace("{ y = [1.65, 1.7] }", "{ rdot = [1.0, 0.0] }"))
    job = next(rows(cases(path))).job
    with pytest.raises(ConfigError, match="set_points"):
        record_of(job)


def test_an_episode_is_a_cycle_and_the_plant_continues(tmp_path: Path) -> None:
    path = tmp_path / "wave.toml"
    path.write_text(WAVE)
    found = {}
    for plan in rows(cases(path)):
        record = record_of(plan.job)
        assert record.traces is not None
        assert len(record.episodes) == CYCLES
        assert len(record.traces.x) == STEPS * CYCLES + 1
        y = np.array(record.traces.x)[:, 1]
        assert np.abs(np.diff(y)).max() < 0.1  # it is not reset to x0
        found[plan.case.config.controller.oracle] = [one.J for one in record.episodes]
        assert record.episodes[1].overshoot == {"y": None}
    # Relative to the true plant's equilibria, no oracle has a lasting lower cost than the true h.
    assert found["perfect"][1] < 0.5 * found["linear"][1]


def test_to_stay_where_the_true_plant_rests_costs_nothing(tmp_path: Path) -> None:
    path = tmp_path / "wave.toml"
    (x,), _u = wave.rests({"y": [1.65]}, 1, true_motion(TRUE), PLANT, 0.05)
    path.write_text(WAVE.replace("[1.65, 1.7]", "[1.65]").replace("[0.4, 1.6, 1.1547, 0.0]", str(x.tolist())))
    job = msgspec.structs.replace(next(rows(cases(path))).job, steps=6, episodes=1)
    record = record_of(job)
    assert record.episodes[0].J < 1e-9
    assert record.performance.J > 1e-5  # relative to (x_e, u_e) the cost is positive


@pytest.mark.parametrize(
    ("values", "why"),
    [
        ("{ p = [1.65, 1.7] }", "is no state; "),
        ("{ y = [1.65, 1.7], z = [0.5, 0.5] }", "as many states as the plant has inputs"),
        ("{ y = [] }", "as many states"),
        ("{ y = [1.65, 7.0] }", "not within its bounds"),
    ],
)
def test_an_invalid_wave_of_this_plant_is_refused(tmp_path: Path, values: str, why: str) -> None:
    path = tmp_path / "wave.toml"
    path.write_text(WAVE.replace("{ y = [1.65, 1.7] }", values))
    with pytest.raises(ConfigError, match=why):
        cases(path)


def test_the_shipped_one_is_valid() -> None:
    found = cases(SHIPPED.with_name("set-points.toml"))
    assert [case.config.controller.oracle for case in found] == [
        *("linear", "constant", "l2nw", "dnn", "perfect"),
        "dnn",
    ]
    assert {case.steps * case.episodes * case.config.period for case in found} == {120.0}
