"""Runs give the same figures for any number of processes and after an interruption; the page needs no other file."""

from __future__ import annotations

import contextlib
import inspect
import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import msgspec
import pytest

from node_runtime.config.plant import plant_of
from run_log.reading.reader import read_run
from run_log.replaying.replay import replay
from run_log.reporting.summary import summarise
from tandem.experiments import experiment
from tandem.experiments.experiment import Finished
from tandem.experiments.simulation.faults import Faults
from tandem.experiments.simulation.lockstep import follow
from tandem.experiments.study.declaration import load
from tandem.experiments.study.lemma import measure
from tandem.experiments.study.plan import CODE, code_version, rows
from tandem.experiments.study.runner import Made, Processes, Progress, RunnerError, Want, run_all, wanted
from tandem.experiments.study.work import read, work
from tests.helpers.interpreter import python
from tests.helpers.paths import write_namesakes
from tests.tandem.experiments.small import PLANT, SMALL, cases


def run_here(
    wants: dict[str, Want],
    folder: Path,
    processes: int = 1,
    progress: Progress = lambda done, total: None,
) -> Made:
    with contextlib.closing(Processes(processes)) as workplace:
        return run_all(wants, folder, workplace, progress)


def run_small(path: Path, out: Path, processes: int) -> Finished:
    return experiment.run(
        load(path),
        str(path),
        PLANT,
        out,
        lambda configs: Processes(processes),
        "tandem experiment small.toml",
        repeats=1,
    )


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
    run_here(few, folder / "alone")
    for key in few:
        assert (folder / "alone" / f"{key}.json").read_bytes() == (
            folder / "out/runs" / f"{key}.json"
        ).read_bytes()


def test_the_summary_has_its_documented_figures(finished: tuple[Path, Finished]) -> None:
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


def test_the_page_needs_no_other_file(finished: tuple[Path, Finished]) -> None:
    _folder, made = finished
    html = made.report.read_text()
    links = re.findall(r"""(?:src|href|url)\s*[=(]\s*["']?([^"'>)\s]+)""", html)
    assert links
    assert all(link.startswith(("data:", "#")) for link in links)
    assert html.count('class="chart"') == 5
    assert "tandem experiment small.toml --only rows" in html
    drawn = {path.name for path in (made.report.parent / "pictures").iterdir()}
    assert drawn == {"comparison.png", "comparison-2.png", "comparison-3.png", "rows.png", "rows-2.png"}


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
    run_here(wants, runs)
    whole = {path.name: path.read_bytes() for path in runs.iterdir()}
    missing, damaged = sorted(whole)[:2]
    (runs / missing).unlink()
    (runs / damaged).write_bytes(whole[damaged][:-20])
    (runs / ".x.json.1.new").write_text("{")
    told: list[tuple[int, int]] = []
    run_here(wants, runs, 1, lambda done, total: told.append((done, total)))
    assert told[0] == (len(wants) - 2, len(wants))
    assert told[-1] == (len(wants), len(wants))
    assert {path.name: path.read_bytes() for path in runs.iterdir()} == whole


@pytest.mark.long
def test_an_interrupted_experiment_continues(small: Path, tmp_path: Path) -> None:
    # The other process reads the code again. This one must too, because files may be edited while tests run.
    code_version.cache_clear()
    small.write_text(SMALL.replace("steps = 30", "steps = 150"))
    out = tmp_path / "out"
    command = [sys.executable, "-m", "tandem", "experiment", str(small), "--out", str(out), "--jobs", "1"]
    command += ["--only", "comparison"]
    # Tests in the background of a shell run with SIGINT ignored, and child processes inherit that.
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
    assert "continues from there" in said
    assert "Traceback" not in said
    kept = {path.name: path.stat().st_mtime_ns for path in runs.glob("*.json")}
    plans = [plan for plan in rows(cases(small)) if plan.case.group == "comparison"]
    wants = wanted(plans, {"comparison"}, tmp_path)
    assert 0 < len(kept) < len(wants)
    run_here(wants, runs, 2)
    assert {name: (runs / name).stat().st_mtime_ns for name in kept} == kept
    assert len(list(runs.iterdir())) == len(wants)


@pytest.mark.long
def test_workers_import_nothing_from_the_current_folder(small: Path, tmp_path: Path) -> None:
    small.write_text(SMALL.replace("steps = 30", "steps = 3", 1))
    here = tmp_path / "here"
    here.mkdir()
    write_namesakes(here)
    # As with the installed `tandem`, whose module path begins with its own folder.
    program = "import sys; sys.path.remove(''); from tandem.cli import main; sys.exit(main())"
    arguments = ("experiment", str(small), "--only", "rows", "--out", "out", "--jobs", "1")
    done = python("-c", program, *arguments, cwd=here)
    assert done.returncode == 0, done.stderr
    assert (here / "out" / "report.html").exists()


def test_a_plant_that_is_edited_during_the_experiment_ends_it(tmp_path: Path) -> None:
    path, truth = tmp_path / "small.toml", tmp_path / "truth.py"
    truth.write_text("from lbmpc.plants import get_plant\nTRUE = get_plant('moore_greitzer')\n")
    path.write_text(SMALL)
    plan = next(plan for plan in rows(cases(path)) if plan.case.name == "linear")
    plant = msgspec.structs.replace(plan.job.config.plant, truth=f"{truth}:TRUE")
    config = msgspec.structs.replace(plan.job.config, plant=plant)
    jobs = [msgspec.structs.replace(plan.job, config=config, steps=steps) for steps in (2, 3, 4, 5)]
    wants = {job.key: Want(job, False, ()) for job in jobs}

    def edit(done: int, total: int) -> None:
        if done == 1:
            truth.write_text(truth.read_text() + "# another\n")

    with pytest.raises(RunnerError, match="was changed while the experiment ran"):
        run_here(wants, tmp_path / "runs", 1, edit)
    kept = {path.stem for path in (tmp_path / "runs").iterdir()}
    assert len(kept) == 1
    assert not kept & {job.key for job in jobs}


@pytest.mark.parametrize("made_by", [work, measure, summarise, Faults, follow, plant_of])
def test_code_that_makes_a_record_is_part_of_its_key(made_by: object) -> None:
    file = str(inspect.getsourcefile(made_by))  # type: ignore[arg-type]
    assert any(f"/{part}/" in file or file.endswith(f"/{part}") for part in CODE)


def test_another_module_beside_the_plant_file_is_another_run(tmp_path: Path) -> None:
    path, truth, valve = tmp_path / "small.toml", tmp_path / "truth.py", tmp_path / "valve.py"
    path.write_text(SMALL)
    truth.write_text("from valve import TRUE\n")
    job = next(iter(rows(cases(path)))).job
    plant = msgspec.structs.replace(job.config.plant, truth=f"{truth}:TRUE")
    job = msgspec.structs.replace(job, config=msgspec.structs.replace(job.config, plant=plant))
    keys = []
    for content in ("TRUE = 1\n", "TRUE = 2\n", "TRUE = 1\n"):
        valve.write_text(content)
        keys.append(job.key)
    assert keys[0] == keys[2] != keys[1]


def test_other_certified_sets_in_the_same_file_are_another_run(tmp_path: Path) -> None:
    path, sets = tmp_path / "small.toml", tmp_path / "sets.npz"
    path.write_text(SMALL)
    job = next(iter(rows(cases(path)))).job
    controller = msgspec.structs.replace(job.config.controller, tightening="invariant", sets=str(sets))
    job = msgspec.structs.replace(job, config=msgspec.structs.replace(job.config, controller=controller))
    keys = set()
    for content in (b"one", b"another"):
        sets.write_bytes(content)
        keys.add(job.key)
    assert len(keys) == 2


def test_something_else_than_a_file_in_the_folder_is_not_replaced(tmp_path: Path) -> None:
    path = tmp_path / "small.toml"
    path.write_text(SMALL)
    want = next(want for want in wanted(list(rows(cases(path))), set(), tmp_path).values() if want.logs)
    want = want._replace(job=msgspec.structs.replace(want.job, steps=2))
    os.mkfifo(want.logs[0])
    with pytest.raises(OSError, match="it is a pipe"):
        run_here({want.job.key: want}, tmp_path / "runs")
    os.mkfifo(tmp_path / "key.json")
    assert read(tmp_path / "key.json", False) is None
