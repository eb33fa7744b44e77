"""Declarations of experiments: strict keys, precedence of the innermost level, the cases, jobs and logs."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest

from node_runtime.config.strict import ConfigError
from tandem.experiments.simulation.faults import Drift, Faults
from tandem.experiments.study.plan import Job, rows
from tandem.experiments.study.runner import wanted
from tandem.experiments.study.timing import timing_job
from tests.helpers.paths import ROOT
from tests.tandem.experiments.small import SHIPPED, SMALL, cases


@pytest.mark.parametrize(
    ("wrong", "right", "expected"),
    [
        ("steps = 30", "stepz = 30", "unknown key 'stepz'; did you mean 'steps'?"),
        ("seeds = 2", "seed = 2", "unknown key 'case[0].seed'; did you mean 'case[0].seeds'?"),
        ('group = "rows"', 'group = "row"', "case[3].group = 'row' is not known; did you mean 'rows'?"),
        ('x0s = "some"', 'x0s = "sume"', "case[0].x0s = 'sume' is not known; did you mean 'some'?"),
        (
            "set.controller.oracle",
            "set.controler.oracle",
            "case 'linear': unknown key 'controler'; did you mean 'controller'?",
        ),
        ('"adaptation.gamma"', '"adaptation.gama"', "unknown key 'adaptation.gama'; did you mean"),
        ("z = [0.4, 0.6]", "zz = [0.4]", "x0s.some.grid = 'zz' is not known; did you mean 'z'?"),
        (
            "log = true",
            "faults.drifts = 1",
            "unknown key 'case[3].faults.drifts'; did you mean 'case[3].faults.drift'?",
        ),
        ('reference = "dnn"', 'reference = "dn"', "reference = 'dn' is not known; did you mean 'dnn'?"),
    ],
)
def test_a_misspelt_key_is_named_with_file_and_nearest(
    small: Path, wrong: str, right: str, expected: str
) -> None:
    small.write_text(SMALL.replace(wrong, right, 1))
    with pytest.raises(ConfigError) as caught:
        cases(small)
    assert str(caught.value).startswith(str(small))
    assert expected in str(caught.value)


def test_a_solver_is_timed_with_rows_and_rate_limits(small: Path) -> None:
    limits = "rows = { a = { z = 1.0, y = -0.5, max = 0.3 } }, input_rate_max = { u = 2.0 }"
    small.write_text(SMALL.replace("[set]", f"[set]\nplant = {{ {limits}, sensors = {{ noise = 0.1 }} }}"))
    plant = timing_job(cases(small)[0], 0, 1.0).config.plant
    assert (list(plant.rows), plant.input_rate_max) == (["a"], {"u": 2.0})
    assert not plant.sensors.random


def test_cases_spread_over_seeds_states_and_values(small: Path) -> None:
    found = {case.name: case for case in cases(small)}
    assert list(found) == ["linear", "l2nw", "dnn", "gamma: gamma = 0.2", "gamma: gamma = 0.5"]
    assert found["dnn"].seeds == [3, 4]
    assert found["dnn"].x0s == [[0.4, 1.6, 1.1547, 0.0], [0.6, 1.6, 1.1547, 0.0]]
    assert found["gamma: gamma = 0.5"].config.adaptation.gamma == 0.5
    plans = list(rows(list(found.values())))
    # linear uses no random numbers: one seed stands for both, as does the floor of every controller from one state.
    assert len(plans) == 2 + 2 + 2 * 2 + 2
    assert len({plan.floor.key for plan in plans}) == 3


def test_the_floor_of_a_plant_that_drifts_drifts_as_well(small: Path) -> None:
    drift = Drift(to={"slope": 1.45}, at=1.0)
    case = msgspec.structs.replace(cases(small)[0], faults=Faults(drift=drift))
    (plan, *_) = rows([case])
    assert plan.floor.config.controller.oracle == "perfect"
    assert plan.floor.faults.drift == drift


LEVELS = """
name = "levels"
title = "Who says it"
config = "compressor-cheap"
steps = 10
episodes = 4
set.adaptation = { gamma = 0.3, start = "zero" }
[quick]
episodes = 3
[[group]]
name = "a"
title = "a"
seeds = 3
steps = 20
set.adaptation.gamma = 0.4
[[case]]
name = "own"
group = "a"
config = "published"
steps = 30
episodes = 1
vary."controller.oracle" = ["linear", "dnn"]
[[case]]
name = "others"
group = "a"
vary."controller.horizon" = [7]
[[case]]
name = "seconds"
group = "a"
config = "compressor"
vary."plant.truth" = [{ slope = 1.4 }]
vary."controller.horizon_seconds" = [2.0]
"""


def test_the_innermost_setting_has_precedence(tmp_path: Path) -> None:
    path = tmp_path / "levels.toml"
    path.write_text(LEVELS)
    linear, network, others, seconds = cases(path)
    assert (network.steps, network.episodes, network.seeds) == (30, 1, [0, 1, 2])
    assert (network.config.rate, network.config.controller.terminal) == (100.0, "published")
    assert (network.config.adaptation.gamma, network.config.adaptation.start) == (0.4, "zero")
    assert (linear.seeds, linear.label, linear.family) == ([0], "linear MPC", "own")
    assert (others.steps, others.episodes) == (20, 4)
    # The base configuration has a horizon too, in seconds and in steps.
    assert (others.config.controller.horizon, others.config.controller.R) == (7, [0.1])
    assert seconds.config.controller.horizon == 40
    assert seconds.config.plant.truth == {"slope": 1.4}
    assert seconds.label == "slope = 1.4, horizon_seconds = 2.0"
    assert [case.episodes for case in cases(path, quick=True)] == [1, 1, 3, 3]
    path.write_text(LEVELS.replace('"published"', '"publisht"'))
    with pytest.raises(ConfigError, match=r"case 'own': config: .*did you mean 'published'"):
        cases(path)


def test_a_key_changes_with_the_settings_and_with_nothing_else(small: Path) -> None:
    job: Job = next(iter(rows(cases(small)))).job
    assert job.key == msgspec.json.decode(msgspec.json.encode(job), type=Job).key
    assert msgspec.structs.replace(job, steps=31).key != job.key


def test_the_shipped_experiment_is_valid_whole_and_quick() -> None:
    whole, quick = cases(SHIPPED), cases(SHIPPED, quick=True)
    assert {case.group for case in quick} <= {case.group for case in whole}
    seeds = {case.name: case.seeds for case in whole}
    assert seeds["compressor: oracle = dnn"] == list(range(20))
    # A case without random numbers is the same for every seed.
    assert seeds["compressor: oracle = linear"] == [0]
    assert any(len(case.x0s) == 25 for case in whole)


@pytest.mark.parametrize(
    "path",
    [
        SHIPPED.with_name("sensors.toml"),
        ROOT / "examples" / "tanks" / "sensors.toml",
        ROOT / "examples" / "quadrotor" / "sensors.toml",
    ],
    ids=lambda path: path.parent.name,
)
def test_the_experiments_with_sensors_are_valid_and_all_have_an_estimator(path: Path) -> None:
    found = cases(path)
    assert {case.config.estimator.kind for case in found} == {"kalman"}
    assert len({case.config.controller.oracle for case in found}) == 4


def test_cases_with_names_alike_have_a_log_each(tmp_path: Path) -> None:
    names = ["a b", "a-b", "a?b", "a\u00a0b", "caf\u00e9", "cafe\u0301", "x" * 60]
    case = '[[case]]\nname = "{}"\ngroup = "g"\nlog = true\nset.controller.oracle = "linear"\n'
    path = tmp_path / "alike.toml"
    path.write_text(
        'name = "alike"\ntitle = "t"\n[[group]]\nname = "g"\ntitle = "t"\n' + "".join(map(case.format, names))
    )
    wants = wanted(list(rows(cases(path))), set(), tmp_path)
    logs = [log.name for want in wants.values() for log in want.logs]
    assert len(wants) == 2  # one job, and the floor for the comparison
    assert len(set(logs)) == len(logs) == len(names)
    assert "a-b-seed0.mcap" in logs
    assert all(log.isascii() and len(log) < 200 for log in logs)


def test_a_value_that_is_varied_twice_is_no_second_case(tmp_path: Path) -> None:
    path = tmp_path / "twice.toml"
    path.write_text(SMALL.replace("[0.2, 0.5]", "[0.5, 0.5]"))
    assert path.read_text() != SMALL
    with pytest.raises(ConfigError, match=r"two cases are called 'gamma: gamma = 0\.5'"):
        cases(path)
