"""`tandem identify`: A, B and W from logs, their quality in the loop, and the logs that it refuses."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from examples.quadrotor.quadrotor import QUADROTOR
from examples.tanks.tanks import TANKS
from lbmpc.model import build_model
from node_runtime.config.loading import load
from node_runtime.config.plant import load_plant
from run_log.reporting.summary import summarise
from run_log.run import Run
from run_log.writing.save import save
from tandem.cli import main
from tandem.experiments.simulation.lockstep import follow
from tandem.plant_file import shared_fields, source, write_new
from tests.helpers.paths import ROOT

Capture = pytest.CaptureFixture[str]
QUICK = ["controller.oracle=constant", "controller.solver.compile=never", "trainer.enabled=false"]
TANKS_FILE = ROOT / "examples" / "tanks" / "tanks.toml"
QUADROTOR_FILE = ROOT / "examples" / "quadrotor" / "quadrotor.toml"
LEAKING = TANKS.varied(**load(TANKS_FILE).plant.truth)
"""The true plant: its outlets are a quarter larger than in the model, and it has a leak."""
FEEDBACKS = (("[2, 4]", 0.01), ("[15, 15]", 0.1), ("[3, 12]", 0.001))
"""x0 and R: three starts, each with another feedback."""
QUADROTOR_FEEDBACKS = (
    ("[0.3, 0.3, 0.1, 0, 0, 0]", "[25, 25, 10, 1, 1, 0.1]", 0.7),
    ("[-0.3, 0.3, -0.1, 0.5, 0, 0]", "[100, 25, 1, 1, 1, 1]", 0.07),
    ("[0.3, -0.3, 0, 0, 0.5, -0.5]", "[5, 25, 50, 1, 1, 0.01]", 7.0),
    ("[-0.3, -0.3, 0.1, -0.4, -0.4, 0.5]", "[25, 25, 1, 1, 1, 2]", 0.7),
    ("[0.1, 0.1, -0.1, 0.3, -0.3, -0.5]", "[2, 25, 30, 1, 1, 0.1]", 0.02),
)


@pytest.fixture(autouse=True)
def a_small_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")


def ran(file: Path | None, settings: list[str], steps: int, noise: float = 0.0) -> Run:
    sensors = [f"plant.sensors.noise={noise}"]  # of half-widths
    return follow(load(file, [*QUICK, *settings, *sensors]), steps).run


def tanks_logs(folder: Path, noise: float = 0.0) -> list[str]:
    files = []
    for x0, r in FEEDBACKS:
        files.append(str(folder / f"run{len(files)}.mcap"))
        save(ran(TANKS_FILE, [f"plant.x0={x0}", f"controller.R=[{r}]"], 80, noise), files[-1])
    return files


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    return tanks_logs(tmp_path_factory.mktemp("logs"))


def identified(capsys: Capture, *words: str) -> dict[str, Any]:
    assert main(["identify", *words, "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def refused(capsys: Capture, *words: str) -> str:
    assert main(["identify", *words]) == 2
    return capsys.readouterr().err


def test_tanks_are_found_within_their_errors_and_better_than_the_model_they_ran_with(
    logs: list[str], capsys: Capture
) -> None:
    found = identified(capsys, *logs)
    true = build_model(LEAKING.resting_near(), 5.0)
    for name in ("A", "B"):
        missed = np.abs(np.array(found[name]) - getattr(true, name))
        assert (missed <= 3.0 * np.array(found[f"{name}_error"])).all()
    assert found["samples"] == 3 * 79
    assert np.array(found["held_out"]["rms"])[0] < 0.1 * np.array(found["log_model"]["rms"])[0]
    assert (np.array(found["held_out"]["rms"]) < 0.1 * np.array(found["nothing_changes"]["rms"])).all()
    assert (np.array(found["W"]) >= 1.25 * np.array(found["held_out"]["largest"]) * TANKS.x_scale).all()
    # Effect at x_e that the model does not contain, cm in 5 s: the leak and the larger outlets.
    slope = np.array(LEAKING.function()(TANKS.x_e, TANKS.u_e))[:, 0]
    np.testing.assert_allclose(found["offset"], 5.0 * slope, atol=0.05)


def test_the_table_fits_a_small_terminal_completely(logs: list[str], capsys: Capture) -> None:
    assert main(["identify", *logs]) == 0
    out = capsys.readouterr().out
    tables = [line for line in out.splitlines() if line.startswith(("h1", "h2", "   "))]
    assert all(len(line) <= 80 for line in tables)
    assert re.search(r"h1\+ +0\.86\d? +0\.00\d+ +0\.16\d +-0\.5", out)
    assert out.count("±") == 2 * (2 + 1 + 1)
    assert re.search(r"held out +the log's model +nothing changes +W per second", out)
    assert re.search(r"poles, 1/s: -0\.01\d+, -0\.03\d+", out)
    assert re.search(r"smallest excitation of any direction: \d\.\d %", out)


def test_the_plant_file_passes_its_check_and_controls_better_than_the_wrong_model(
    logs: list[str], tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    found = identified(capsys, *logs, "--out", "found.py")
    assert main(["model", "check", "found.py", "--json"]) == 0
    checked = json.loads(capsys.readouterr().out)
    assert checked["faults"] == []
    assert checked["period"] == 5.0
    for name in ("A", "B", "W"):
        np.testing.assert_allclose(checked[name], found[name], rtol=1e-11)
    Path("true.py").write_text("from tests.tandem.commands.test_identify import LEAKING\nTRUE = LEAKING\n")
    costs, misses = [], []
    linear = ["controller.oracle=linear", "controller.tightening=none", "plant.truth=true.py:TRUE"]
    own = f"{TANKS_FILE.parent}/tanks.py:TANKS"
    for model in (own, "found.py:PLANT"):
        run = ran(TANKS_FILE, [*linear, f"plant.model={model}"], 150)
        costs.append(summarise(run).J)
        misses.append(abs(run.plant_states[-1].x[1] - TANKS.x_e[1]))
    # It knows the outlets and the leak, so that there is no offset.
    assert costs[1] < 0.9 * costs[0]
    assert misses[1] < 0.1 * misses[0]


def test_a_quadrotor_in_wind_is_found_from_five_short_flights(tmp_path: Path, capsys: Capture) -> None:
    files = []
    for x0, q, r in QUADROTOR_FEEDBACKS:
        files.append(str(tmp_path / f"run{len(files)}.mcap"))
        own = [f"plant.x0={x0}", f"controller.Q={q}", f"controller.R=[{r}, {r}]"]
        save(ran(QUADROTOR_FILE, [*own, "controller.horizon_seconds=0.4"], 70), files[-1])
    found = identified(capsys, *files)
    # Positions follow from speeds exactly; only accelerations differ from the model.
    for state in (3, 4):
        assert found["held_out"]["rms"][state] < 0.25 * found["log_model"]["rms"][state]
    # 7 % less thrust, seen in the torque, which has no other disturbance.
    nominal = build_model(QUADROTOR, 0.02).B
    np.testing.assert_allclose(np.array(found["B"])[5], 0.93 * nominal[5], rtol=1e-6)
    assert main(["identify", *files]) == 0
    assert all(len(line) <= 80 for line in capsys.readouterr().out.splitlines() if "±" in line)


def test_noise_widens_w_and_the_errors(logs: list[str], tmp_path: Path, capsys: Capture) -> None:
    quiet = identified(capsys, *logs)
    noisy = identified(capsys, *tanks_logs(tmp_path, noise=0.05 / 9.5))
    assert (np.array(noisy["W"]) > np.array(quiet["W"])).all()
    # The noise of two samples, per second.
    assert noisy["held_out"]["rms"][1] == pytest.approx(0.05 * np.sqrt(1.9) / 9.5 / 5.0, rel=0.3)
    true = build_model(LEAKING.resting_near(), 5.0)
    assert (np.abs(np.array(noisy["A"]) - true.A) < 4.0 * np.array(noisy["A_error"])).all()


def test_one_linear_feedback_is_refused_with_its_equation(tmp_path: Path, capsys: Capture) -> None:
    """Near x_e no bound acts, and the controller without learning is u = K x."""
    save(
        ran(None, ["controller.oracle=linear", "plant.x0=[0.45, 1.65, 1.15, 0]"], 100),
        tmp_path / "run.mcap",
    )
    text = refused(capsys, str(tmp_path / "run.mcap"))
    assert re.search(r"run.mcap: the samples do not determine A and B:\n  - u = .*\+ constant, to", text)
    assert "the input is a linear function of the other variables, as under one fixed feedback" in text
    assert "Record motion that differs: from several x0" in text


def test_a_constant_input_is_refused_by_its_name(tmp_path: Path, capsys: Capture) -> None:
    """The pump cannot compensate the leak: it is at its limit from the first sample on."""
    bounds = ["plant.bounds={ q = [0.0, 8.0] }", "controller.oracle=linear"]
    save(ran(TANKS_FILE, bounds, 80), tmp_path / "run.mcap")
    text = refused(capsys, str(tmp_path / "run.mcap"))
    assert "q hardly moves: by 0 % of its half-width (RMS)" in text
    assert "linear function" not in text


def test_short_and_noisy_logs_are_refused(tmp_path: Path, capsys: Capture) -> None:
    save(ran(TANKS_FILE, [], 20), tmp_path / "short.mcap")
    text = refused(capsys, str(tmp_path / "short.mcap"))
    assert re.search("19 samples are too few: .* has 4 numbers .* and needs at least 40 samples", text)
    save(ran(TANKS_FILE, ["plant.x0=[8, 11]"], 120, noise=1.0 / 9.5), tmp_path / "noisy.mcap")
    assert "is not explained by any model, like measurement noise" in refused(
        capsys, str(tmp_path / "noisy.mcap")
    )


def test_contradicting_arguments_are_refused(logs: list[str], tmp_path: Path, capsys: Capture) -> None:
    save(ran(TANKS_FILE, ["rate=0.1"], 30), tmp_path / "slow.mcap")
    save(ran(None, [], 30), tmp_path / "other.mcap")
    assert "slow.mcap: sampled every 10 s, and" in refused(capsys, logs[0], str(tmp_path / "slow.mcap"))
    assert "its plant (moore_greitzer)" in refused(capsys, logs[0], str(tmp_path / "other.mcap"))
    (tmp_path / "found.py").write_text("kept")
    for out, message in (
        ("found.py", "exists already and is not overwritten"),
        ("found.txt", "must end in .py"),
        ("away/found.py", "there is no folder"),
    ):
        assert message in refused(capsys, *logs, "--out", str(tmp_path / out))
    assert (tmp_path / "found.py").read_text() == "kept"
    assert "cannot be read" in refused(capsys, str(tmp_path / "none.mcap"))


def test_names_from_another_person_are_restored_from_the_file(tmp_path: Path) -> None:
    states = ("höhe 😀", 'b" or c\\', "d'\"", "\u202ee\n")
    fields = {"A": -np.eye(4), "B": np.ones((4, 1)), "W": np.ones(4), "states": states, "scale": {"u1": 1.0}}
    fields["scale"] |= dict.fromkeys(states, 2.0)
    text = source(fields, ['"""\nimport nothing # \\', "a log of \udcff\u202e.mcap", ""])
    write_new(tmp_path / "found.py", text)
    known = load_plant(f"{tmp_path / 'found.py'}:PLANT")
    assert shared_fields(known)["dead_time"] is None
    assert shared_fields(replace(known, dead_time=0.25))["dead_time"] == 0.25
    assert known.states == states
    assert known.scale[states[0]] == 2.0
    assert "\u202e" not in text
