"""Experiments: one strict file; the same figures for any number of processes and after an interruption; a page that
needs nothing else."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from lbmpc.plants import get_plant
from node_runtime.config.strict import ConfigError
from run_log.reading.reader import read_run
from run_log.replaying.replay import replay
from run_log.reporting.performance import Performance
from tandem.experiments import experiment
from tandem.experiments.experiment import Finished
from tandem.experiments.reporting import findings, pictures
from tandem.experiments.reporting.page import _table
from tandem.experiments.simulation.faults import Drift, Faults
from tandem.experiments.study import results
from tandem.experiments.study.declaration import Picture, Resolved, load, resolve
from tandem.experiments.study.plan import Job, code_version, rows
from tandem.experiments.study.runner import run_all, wanted
from tandem.experiments.study.work import Record, Traces, read, work
from tests.helpers.paths import CONFIGS, write_namesakes
from tests.helpers.plants.pendulum import PENDULUM

PLANT = get_plant("moore_greitzer")
SHIPPED = CONFIGS / "experiments" / "paper.toml"
SMALL = """
name = "small"
title = "A small one"
steps = 30
[set]
controller = { horizon = 15, solver = { compile = "never" } }
network = { hidden = [6] }
trainer = { steps = 5 }
[x0s.some]
grid = { z = [0.4, 0.6], y = [1.6] }
[[group]]
name = "comparison"
title = "Comparison"
picture = "trajectories"
reference = "dnn"
[[case]]
name = "linear"
group = "comparison"
set.controller.oracle = "linear"
x0s = "some"
seeds = 2
[[case]]
name = "l2nw"
group = "comparison"
set.controller.oracle = "l2nw"
x0s = "some"
[[case]]
name = "dnn"
group = "comparison"
label = "network"
x0s = "some"
seeds = [3, 4]
[[group]]
name = "rows"
title = "Rows"
picture = "lemma"
[[case]]
name = "gamma"
group = "rows"
vary."adaptation.gamma" = [0.2, 0.5]
log = true
"""


@pytest.fixture
def small(tmp_path: Path) -> Path:
    path = tmp_path / "small.toml"
    path.write_text(SMALL)
    return path


def cases(path: Path, quick: bool = False) -> list[Resolved]:
    return resolve(load(path), PLANT, str(path), quick)


def run_small(path: Path, out: Path, processes: int) -> Finished:
    return experiment.run(
        load(path), str(path), PLANT, out, processes, "tandem experiment small.toml", repeats=1
    )


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


def test_cases_spread_over_seeds_states_and_values(small: Path) -> None:
    found = {case.name: case for case in cases(small)}
    assert list(found) == ["linear", "l2nw", "dnn", "gamma: gamma = 0.2", "gamma: gamma = 0.5"]
    assert found["dnn"].seeds == [3, 4]
    assert found["dnn"].x0s == [[0.4, 1.6, 1.1547, 0.0], [0.6, 1.6, 1.1547, 0.0]]
    assert found["gamma: gamma = 0.5"].config.adaptation.gamma == 0.5
    plans = list(rows(list(found.values())))
    # linear draws nothing: one seed stands for both; so does the floor of every controller from one state.
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


def test_the_nearest_level_that_says_something_counts(tmp_path: Path) -> None:
    path = tmp_path / "levels.toml"
    path.write_text(LEVELS)
    linear, network, others, seconds = cases(path)
    assert (network.steps, network.episodes, network.seeds) == (30, 1, [0, 1, 2])
    assert (network.config.rate, network.config.controller.terminal) == (100.0, "published")
    assert (network.config.adaptation.gamma, network.config.adaptation.start) == (0.4, "zero")
    assert (linear.seeds, linear.label, linear.family) == ([0], "linear MPC", "own")
    assert (others.steps, others.episodes) == (20, 4)
    # The configuration that it starts from has a horizon too, in seconds and in steps.
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
    # What draws nothing is the same for every seed.
    assert seeds["compressor: oracle = linear"] == [0]
    assert any(len(case.x0s) == 25 for case in whole)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Finished]:
    folder = tmp_path_factory.mktemp("experiment")
    path = folder / "small.toml"
    path.write_text(SMALL)
    return folder, run_small(path, folder / "out", 2)


def test_figures_do_not_depend_on_the_number_of_processes(finished: tuple[Path, Finished]) -> None:
    folder, _made = finished
    plans = list(rows(cases(folder / "small.toml")))
    wants = wanted(plans, {"comparison", "rows"}, folder / "no-logs")
    few = {key: want for key, want in wants.items() if not want.logs}
    run_all(few, folder / "alone", 1)
    for key in few:
        assert (folder / "alone" / f"{key}.json").read_bytes() == (
            folder / "out/runs" / f"{key}.json"
        ).read_bytes()


def test_the_summary_has_what_it_promises(finished: tuple[Path, Finished]) -> None:
    _folder, made = finished
    told = json.loads(made.summary.read_text())
    assert len(told["rows"]) == 10
    promised = (
        "case oracle seed x0 J regret deviation overshoot settled_s settled_by_state_s violations solve_ms "
        "excess_between_samples iteration_limit_ticks soft_ticks fallback_ticks"
    )
    for row in told["rows"]:
        assert set(promised.split()) <= row.keys()
        assert len(row["x0"]) == 4
        assert set(row["overshoot"]) == {"z", "y"}
        assert row["excess_between_samples"] == 0.0
        assert set(row["solve_ms"]) == {"p50", "p99", "max"}
        assert row["J_by_episode"] == [row["J"]]
        assert row["regret_by_episode"] == [row["regret"]]


def test_the_page_needs_nothing_else(finished: tuple[Path, Finished]) -> None:
    _folder, made = finished
    html = made.report.read_text()
    links = re.findall(r"""(?:src|href|url)\s*[=(]\s*["']?([^"'>)\s]+)""", html)
    assert links
    assert all(link.startswith(("data:", "#")) for link in links)
    assert "<script" not in html
    assert html.count("<img") == 4
    assert "tandem experiment small.toml --only rows" in html


def test_the_log_of_a_run_replays(finished: tuple[Path, Finished]) -> None:
    folder, made = finished
    logs = sorted((folder / "out/logs").glob("*.mcap"))
    assert len(logs) == made.logs == 2
    assert replay(read_run(logs[0])).equal


def test_only_what_is_missing_or_damaged_runs_again(finished: tuple[Path, Finished]) -> None:
    folder, _made = finished
    plans = list(rows(cases(folder / "small.toml")))
    wants = wanted(
        [plan for plan in plans if plan.case.name in ("linear", "l2nw")], set(), folder / "no-logs"
    )
    runs = folder / "again"
    run_all(wants, runs, 1)
    whole = {path.name: path.read_bytes() for path in runs.iterdir()}
    missing, damaged = sorted(whole)[:2]
    (runs / missing).unlink()
    (runs / damaged).write_bytes(whole[damaged][:-20])
    (runs / "x.1.partial").write_text("{")
    told: list[tuple[int, int]] = []
    run_all(wants, runs, 1, lambda done, total: told.append((done, total)))
    assert told[0] == (len(wants) - 2, len(wants))
    assert told[-1] == (len(wants), len(wants))
    assert {path.name: path.read_bytes() for path in runs.iterdir()} == whole


def test_an_interrupted_experiment_goes_on(small: Path, tmp_path: Path) -> None:
    # The other process reads the code anew; so must this one, where somebody edits while tests run.
    code_version.cache_clear()
    small.write_text(SMALL.replace("steps = 30", "steps = 150"))
    out = tmp_path / "out"
    command = [sys.executable, "-m", "tandem", "experiment", str(small), "--out", str(out), "--jobs", "1"]
    command += ["--only", "comparison"]
    # Who runs the tests in the background of a shell runs them with SIGINT ignored, and that is inherited.
    started = subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    runs = out / "runs"
    while not list(runs.glob("*.json")):
        with contextlib.suppress(subprocess.TimeoutExpired):
            raise AssertionError(f"ended with {started.wait(0.02)}")
    started.send_signal(signal.SIGINT)
    said, _ = started.communicate(timeout=120)
    assert started.returncode == 130, said
    assert "goes on from there" in said
    assert "Traceback" not in said
    kept = {path.name: path.stat().st_mtime_ns for path in runs.glob("*.json")}
    plans = [plan for plan in rows(cases(small)) if plan.case.group == "comparison"]
    wants = wanted(plans, {"comparison"}, tmp_path)
    assert 0 < len(kept) < len(wants)
    run_all(wants, runs, 2)
    assert {name: (runs / name).stat().st_mtime_ns for name in kept} == kept
    assert len(list(runs.iterdir())) == len(wants)


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


def test_workers_import_nothing_from_the_current_folder(small: Path, tmp_path: Path) -> None:
    small.write_text(SMALL.replace("steps = 30", "steps = 3", 1))
    here = tmp_path / "here"
    here.mkdir()
    write_namesakes(here)
    # As the installed `tandem`, whose own path begins with its folder.
    program = "import sys; sys.path.remove(''); from tandem.cli import main; sys.exit(main())"
    arguments = ("experiment", str(small), "--only", "rows", "--out", "out", "--jobs", "1")
    done = subprocess.run(
        [sys.executable, "-c", program, *arguments],
        capture_output=True,
        text=True,
        timeout=300,
        cwd=here,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert (here / "out" / "report.html").exists()


def test_words_follow_from_the_figures() -> None:
    base = a_result("base", [21.0, 21.1, 21.2, 21.3])
    worse, same = a_result("worse", [22.0, 22.1, 22.2, 22.3]), a_result("same", [21.3, 21.2, 21.0, 21.1])
    breaks = a_result("breaks", [21.0, 21.1, 21.2, 21.3], violations=3)
    said = findings.compare([base, worse, same, breaks], "base")
    assert said[0] == "Matters, against base: worse, breaks."
    assert said[1] == "No clear difference from base: same."
    assert "more J, 22.1 against 21.1 in the median in all 4 pairs" in said[2]
    assert "keeps all constraints at samples in 0 of 4 runs, against 4 of 4 runs" in said[3]


def test_regret_is_signed_and_a_page_says_where_the_true_h_is_beaten() -> None:
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


def test_what_is_lost_not_settled_or_not_known_are_three_things() -> None:
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


def test_a_record_that_lacks_what_is_wanted_is_not_taken(tmp_path: Path) -> None:
    path = tmp_path / "run.json"
    path.write_bytes(msgspec.json.encode(a_record(1.0, 0.0)))
    assert read(path, detail=False) is not None
    assert read(path, detail=True) is None


def test_cases_with_names_alike_have_a_log_each(tmp_path: Path) -> None:
    names = ["a b", "a-b", "a?b", "a\u00a0b", "caf\u00e9", "cafe\u0301", "x" * 60]
    case = '[[case]]\nname = "{}"\ngroup = "g"\nlog = true\nset.controller.oracle = "linear"\n'
    path = tmp_path / "alike.toml"
    path.write_text(
        'name = "alike"\ntitle = "t"\n[[group]]\nname = "g"\ntitle = "t"\n' + "".join(map(case.format, names))
    )
    wants = wanted(list(rows(cases(path))), set(), tmp_path)
    logs = [log.name for want in wants.values() for log in want.logs]
    assert len(wants) == 2  # one job, and the floor that all are compared with
    assert len(set(logs)) == len(logs) == len(names)
    assert "a-b-seed0.mcap" in logs
    assert all(log.isascii() and len(log) < 200 for log in logs)


def test_a_value_that_is_varied_twice_is_no_second_case(tmp_path: Path) -> None:
    path = tmp_path / "twice.toml"
    path.write_text(SMALL.replace("[0.2, 0.5]", "[0.5, 0.5]"))
    assert path.read_text() != SMALL
    with pytest.raises(ConfigError, match=r"two cases are called 'gamma: gamma = 0\.5'"):
        cases(path)


def test_something_else_than_a_file_in_the_folder_is_not_replaced(tmp_path: Path) -> None:
    path = tmp_path / "small.toml"
    path.write_text(SMALL)
    want = next(want for want in wanted(list(rows(cases(path))), set(), tmp_path).values() if want.logs)
    os.mkfifo(want.logs[0])
    with pytest.raises(OSError, match="it is a pipe"):
        work(msgspec.structs.replace(want.job, steps=2), "key", tmp_path, False, want.logs)
    os.mkfifo(tmp_path / "key.json")
    assert read(tmp_path / "key.json", False) is None
