"""A user's plant file at the command line: named, simulated, logged, and replayed without the file."""

from __future__ import annotations

import json
import shutil
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest

from controller_node.build import build_plant
from run_log.reading.reader import read_run
from run_log.reading.recover import recover
from run_log.replaying.replay import replay
from tandem.cli import main
from tandem.experiments.experiment import settings
from tandem.experiments.simulation.faults import Faults
from tandem.experiments.study.declaration import load, resolve
from tandem.experiments.study.plan import Job
from tests.helpers.plants.tanks import OPTIONS, TRUE, write_tanks

STEPS = ("--steps", "30")
CHUNKS = ("--set", "log.chunk_bytes=4096")
"""Small chunks, so that a cut log contains some."""
PERFECT = ("--set", "controller.oracle=perfect")


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder, and a module search path that is restored after the test."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    return tmp_path


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a plant file, and logs of runs with it: run.mcap and perfect.mcap."""
    folder = tmp_path_factory.mktemp("made")
    write_tanks(folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(sys, "path", list(sys.path))
        assert main(["simulate", *OPTIONS, *CHUNKS, *STEPS, "--log", "run.mcap"]) == 0
        assert main(["simulate", *OPTIONS, *PERFECT, *STEPS, "--log", "perfect.mcap"]) == 0
    return folder


@pytest.fixture
def elsewhere(made: Path, here: Path) -> Path:
    """A folder with the logs alone. The plant file that they name would end a process that loads it."""
    for log in made.glob("*.mcap"):
        shutil.copy(log, here)
    file = made / "tanks.py"
    sound = file.read_text()
    file.write_text("import os\nos._exit(99)\n")
    yield here
    file.write_text(sound)


def said(capsys: pytest.CaptureFixture[str]) -> str:
    """Return the printed output with joined lines."""
    captured = capsys.readouterr()
    return " ".join((captured.out + captured.err).split())


def as_json(capsys: pytest.CaptureFixture[str], *words: str, code: int = 0) -> dict[str, Any]:
    capsys.readouterr()
    assert main([*words, "--json"]) == code
    return json.loads(capsys.readouterr().out)


def test_replay_with_the_file_is_equal_byte_for_byte(made: Path, capsys: pytest.CaptureFixture[str]):
    assert as_json(capsys, "replay", str(made / "run.mcap"))["equal"]


def test_a_controller_with_another_plant_than_the_recorder_is_named(made: Path):
    run = read_run(made / "run.mcap")
    assert replay(run).notes == []
    assert run.plant is not None
    run.plant = run.plant.changed({"pump": (0.0, 0.11)})
    assert any("had another plant than the recorder" in note for note in replay(run).notes)


def test_a_log_has_the_known_plant_and_the_hash_of_its_file(made: Path):
    run = read_run(made / "run.mcap")
    assert run.plant is not None
    assert (run.plant.name, run.plant.states) == ("tanks", ("upper", "lower"))
    assert list(run.files) == ["plant.model"]


def test_replay_report_and_recover_load_nothing_that_a_log_names(
    elsewhere: Path, capsys: pytest.CaptureFixture[str]
):
    assert as_json(capsys, "replay", "run.mcap")["equal"]
    assert main(["report", "run.mcap", "--json"]) == 0
    text = said(capsys)
    assert '"excess_between_samples":null' in text
    assert "the motion between samples is unknown" in text
    log = elsewhere / "run.mcap"
    (elsewhere / "cut.mcap").write_bytes(log.read_bytes()[: log.stat().st_size * 3 // 4])
    assert recover("cut.mcap", "whole.mcap").log == "whole.mcap"
    assert as_json(capsys, "replay", "whole.mcap")["equal"]


def test_a_replay_that_needs_equations_names_the_option_for_them(
    elsewhere: Path, capsys: pytest.CaptureFixture[str]
):
    assert main(["replay", "perfect.mcap"]) == 2
    text = said(capsys)
    assert "it needs the equations of the true plant" in text
    assert "--plant FILE:NAME gives the replay the equations of its plant" in text
    write_tanks(elsewhere)
    found = as_json(capsys, "replay", "perfect.mcap", "--plant", "tanks.py:TANKS")
    assert found["equal"]
    assert found["notes"] == []


def test_the_file_that_is_named_gives_a_report_its_motion_between_samples(
    elsewhere: Path, capsys: pytest.CaptureFixture[str]
):
    write_tanks(elsewhere)
    assert as_json(capsys, "report", "run.mcap", "--plant", "tanks.py:TANKS")["excess_between_samples"] == 0.0


def test_a_file_that_differs_from_the_logs_is_reported(elsewhere: Path, capsys: pytest.CaptureFixture[str]):
    file = write_tanks(elsewhere)
    file.write_text(file.read_text() + "# another\n")
    (note,) = as_json(capsys, "replay", "run.mcap", "--plant", "tanks.py:TANKS")["notes"]
    assert note.startswith("tanks.py:TANKS is not the file that the log names: its sha256 is ")
    file.write_text(file.read_text().replace("0.1 * ca.sqrt(x[1])", "0.1 * x[1]"))
    *_, note = as_json(capsys, "replay", "run.mcap", "--plant", "tanks.py:TANKS")["notes"]
    assert note == "tanks.py:TANKS differs from the log in A; the values of the log are used"
    assert main(["report", "run.mcap", "--plant", "tanks.py:TANKS"]) == 0
    assert "is not the file that the log names" in said(capsys)


@pytest.mark.parametrize("command", ["replay", "report"])
def test_mistakes_in_a_named_plant_file(command: str, elsewhere: Path, capsys: pytest.CaptureFixture[str]):
    assert main([command, "run.mcap", "--plant", "tanks.py:TANKS"]) == 2
    assert f"{elsewhere}/tanks.py: no such file" in said(capsys)
    (elsewhere / "tanks.py").write_text("TANKS = 1 / 0\n")
    assert main([command, "run.mcap", "--plant", "tanks.py:TANKS"]) == 2
    assert f"{elsewhere}/tanks.py, line 1: ZeroDivisionError" in said(capsys)
    assert main([command, "run.mcap", "--plant", "moore_greitzer"]) == 2


def test_a_change_of_a_replay_may_name_code(elsewhere: Path, capsys: pytest.CaptureFixture[str]):
    file = write_tanks(elsewhere)
    file.write_text(file.read_text().replace("x_max=[2.0, 2.0]", "x_max=[2.0, 3.0]"))
    found = as_json(capsys, "replay", "run.mcap", "--set", "plant.model=tanks.py:TANKS", code=1)
    assert found["largest_difference"] > 0.0
    narrow = as_json(capsys, "replay", "run.mcap", "--set", "plant.bounds.pump=[0.0, 0.105]", code=1)
    assert narrow["largest_difference"] > 0.0


# -- the configuration ----------------------------------------------------------------------------------------


def shown(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    capsys.readouterr()
    assert main(["config", "show", *words]) == 0
    return capsys.readouterr().out


def test_the_shown_configuration_is_in_force_and_can_be_loaded(
    here: Path, capsys: pytest.CaptureFixture[str]
):
    write_tanks(here)
    bounds = ("--set", "plant.bounds.pump=[0.05, 0.2]")
    text = shown(capsys, *OPTIONS, *bounds)
    plant, controller = (tomllib.loads(text)[name] for name in ("plant", "controller"))
    assert plant["model"] == f"{here}/tanks.py:TANKS"
    assert plant["bounds"] == {"upper": [0.2, 2.0], "lower": [0.2, 2.0], "pump": [0.05, 0.2]}
    assert (plant["x0"], plant["x_e"], plant["u_e"]) == ([0.5, 0.5], [1.0, 1.0], [0.1])
    assert (controller["W"], controller["Q"], controller["R"]) == ([0.02, 0.02], [1.0, 1.0], [1.0])
    (here / "folder").mkdir()
    (here / "folder" / "shown.toml").write_text(text)
    again = ("--config", "folder/shown.toml")
    assert shown(capsys, *again) == text
    one, other = (as_json(capsys, "simulate", *words, *STEPS) for words in ((*OPTIONS, *bounds), again))
    assert one["J"] == other["J"]


def test_bounds_and_equilibrium_of_the_configuration_are_in_the_log(
    here: Path, capsys: pytest.CaptureFixture[str]
):
    write_tanks(here)
    at = ("--set", "plant.x_e=[1.21, 1.21]", "--set", "plant.u_e=[0.11]")
    words = (*OPTIONS, *at, "--set", "plant.bounds.pump=[0.0, 0.12]", *STEPS)
    assert main(["simulate", *words, "--log", "run.mcap"]) == 0
    run = read_run(here / "run.mcap")
    assert run.plant is not None
    assert (run.plant.x_e.tolist(), run.plant.u_max.tolist()) == ([1.21, 1.21], [0.12])
    # The slope -0.1 / (2 sqrt(x)) at the configured x_e, which is not the file's.
    assert run.plant.A[0, 0] == pytest.approx(-0.05 / 1.1)
    assert max(command.u[0] for command in run.commands) == pytest.approx(0.12)
    (here / "tanks.py").unlink()
    assert as_json(capsys, "replay", "run.mcap")["equal"]


@pytest.mark.parametrize(
    ("setting", "text"),
    [
        (
            "plant.model=tanks.py:TANK",
            "plant.model: {here}/tanks.py:TANK: {here}/tanks.py has nothing called 'TANK'",
        ),
        ("plant.model=tanks.py:TANK", "did you mean 'TANKS'?"),
        ("plant.model=bad.py:PLANT", "plant.model: {here}/bad.py, line 2: RuntimeError: no licence"),
        ("plant.model=odd.py:PLANT", "x_e is [1.0]: it needs 2 entries, one for each of upper, lower"),
        (
            "plant.bounds.upperr=[0, 1]",
            "plant.bounds: tanks has no state or input 'upperr'; did you mean 'upper'?",
        ),
        ("plant.bounds.upper=[1, 0]", "x_min of upper is 1 and x_max is 0: the lower bound must be below"),
        ("plant.x_e=[1.0]", "plant.x_e has 1 entries; tanks has 2 states (upper, lower)"),
        (
            "plant.x_e=[1.5, 1.0]",
            "no input holds it there: x_e = [1.5, 1.0]. The nearest rest is x_e = [1.0, 1.0]",
        ),
        (
            'plant={model = "tanks.py:TANKS", x_e = [1.5, 1.0], u_e = [0.1]}',
            "(x_e, u_e) is not an equilibrium",
        ),
        ("plant.truth.leek=1", "tanks has no parameter 'leek'; did you mean 'leak'?"),
    ],
)
def test_mistakes_are_named_before_anything_begins(
    setting: str, text: str, here: Path, capsys: pytest.CaptureFixture[str]
):
    file = write_tanks(here)
    (here / "bad.py").write_text("\nraise RuntimeError('no licence')\n")
    (here / "odd.py").write_text(
        file.read_text().replace("x_e=[1.0, 1.0]", "x_e=[1.0]").replace("TANKS =", "PLANT =")
    )
    for command in (["simulate", *STEPS], ["config", "show"], ["plant"], ["record"]):
        assert main([*command, *OPTIONS, "--set", setting]) == 2
        assert text.format(here=here) in said(capsys)


EXPERIMENT = """
name = "tanks"
title = "Tanks"
steps = 10
set = { plant = { model = "tanks.py:TANKS" }, rate = 1, controller = { horizon = 10, oracle = "linear" } }
[[group]]
name = "all"
title = "All"
[[case]]
name = "linear"
group = "all"
set.controller.solver.compile = "never"
"""


def test_an_experiment_finds_the_plant_file_beside_itself_in_all_its_processes(
    here: Path, capsys: pytest.CaptureFixture[str]
):
    (here / "study").mkdir()
    file = write_tanks(here / "study")
    (here / "study" / "tanks.toml").write_text(EXPERIMENT)
    found = as_json(capsys, "experiment", "study/tanks.toml", "--out", "out", "--jobs", "1")
    (row,) = found["rows"]
    assert row["J"] > 0.0
    declared, where = load(here / "study" / "tanks.toml"), "study/tanks.toml"
    (case,) = resolve(declared, build_plant(settings(declared, where)), where)
    job = Job(config=case.config, steps=10, episodes=1, faults=Faults())
    before = job.key
    file.write_text(file.read_text() + "# changed\n")
    assert job.key != before


# -- a user's simulator as the true plant ------------------------------------------------------------------------


def test_an_object_with_step_moves_in_the_plants_place(here: Path, capsys: pytest.CaptureFixture[str]):
    write_tanks(here)
    (here / "true.py").write_text(TRUE)
    truth = ("--set", "plant.truth=true.py:LEAKING")
    right = as_json(capsys, "simulate", *OPTIONS, *STEPS)
    wrong = as_json(capsys, "simulate", *OPTIONS, *truth, *STEPS, "--log", "run.mcap")
    assert wrong["J"] > right["J"]
    assert set(read_run(here / "run.mcap").files) == {"plant.model", "plant.truth"}
    (here / "true.py").write_text("import os\nos._exit(99)\n")
    (here / "tanks.py").write_text("import os\nos._exit(99)\n")
    assert as_json(capsys, "replay", "run.mcap")["equal"]
    assert as_json(capsys, "report", "run.mcap")["excess_between_samples"] is None


def test_another_plant_is_the_truth_where_states_and_inputs_are_the_same(
    here: Path, capsys: pytest.CaptureFixture[str]
):
    file = write_tanks(here)
    (here / "true.py").write_text(file.read_text().replace("leak=0.0", "leak=0.01"))
    truth = ("--set", "plant.truth=true.py:TANKS")
    named = as_json(capsys, "simulate", *OPTIONS, *truth, *STEPS, "--log", "run.mcap")
    varied = as_json(capsys, "simulate", *OPTIONS, "--set", "plant.truth.leak=0.01", *STEPS)
    assert named["J"] == varied["J"]
    assert named["excess_between_samples"] == 0.0
    report = as_json(capsys, "report", "run.mcap", "--plant", "true.py:TANKS")
    assert report["excess_between_samples"] == 0.0
    assert main(["simulate", *OPTIONS, "--set", "plant.truth=moore_greitzer", *STEPS]) == 2
    assert "its states are z, y, r, rdot, and those of the model upper, lower" in said(capsys)


def test_perfect_replays_a_named_truth_once_it_is_named_again(here: Path, capsys: pytest.CaptureFixture[str]):
    file = write_tanks(here)
    (here / "true.py").write_text(file.read_text().replace("leak=0.0", "leak=0.01"))
    truth = ("--set", "plant.truth=true.py:TANKS")
    assert main(["simulate", *OPTIONS, *PERFECT, *truth, *STEPS, "--log", "run.mcap"]) == 0
    assert main(["replay", "run.mcap", "--plant", "tanks.py:TANKS"]) == 2
    assert "--set plant.truth=FILE:NAME gives the replay its true plant" in said(capsys)
    assert as_json(capsys, "replay", "run.mcap", "--plant", "tanks.py:TANKS", *truth)["equal"]


@pytest.mark.parametrize(
    ("body", "text"),
    [
        ("raise RuntimeError('no licence')", "Own.step: RuntimeError: no licence"),
        ("return [1.0]", "Own.step: it returned an array of shape (1,), but the state has (2,)"),
        ("return [float('nan'), 1.0]", "Own.step: the state is not finite"),
        ("return 'nonsense'", "Own.step: ValueError"),
    ],
)
def test_a_truth_that_fails_ends_the_run_with_the_cause(
    body: str, text: str, here: Path, capsys: pytest.CaptureFixture[str]
):
    write_tanks(here)
    (here / "true.py").write_text(f"class Own:\n    def step(self, x, u, dt):\n        {body}\nOWN = Own()\n")
    assert main(["simulate", *OPTIONS, "--set", "plant.truth=true.py:OWN", *STEPS]) == 1
    assert f"the plant was lost: at step 1 of 30: {text}" in said(capsys)
