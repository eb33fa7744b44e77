"""`tandem model check` reports all faults of a plant, and notes on unusual properties."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

from examples.tanks.tanks import TANKS
from lbmpc.plants import PLANTS, Known, Plant
from tandem.cli import main
from tandem.commands.model.check import ModelCheck
from tests.helpers.plants.integrator import INTEGRATOR
from tests.helpers.plants.pendulum import PENDULUM
from tests.lbmpc.plants.test_inspection import FAULTY
from tests.lbmpc.plants.test_known import FAULTY as FAULTY_NUMBERS

Capture = pytest.CaptureFixture[str]
TEN = ("--rate", "10", "--set", "controller.horizon=20")


@pytest.fixture(autouse=True)
def a_small_terminal_in_an_empty_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def mine(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Register a plant under the name "mine"."""
    return lambda plant: monkeypatch.setitem(PLANTS, "mine", plant)


def checked(capsys: Capture, *words: str) -> tuple[int, dict[str, Any]]:
    code = main(["model", "check", *words, "--json"])
    return code, json.loads(capsys.readouterr().out)


def refused(capsys: Capture, plant: str) -> str:
    """Return the faults, without parsing a command line."""
    assert ModelCheck(plant=plant, json=True).run() == 2
    return " ".join(json.loads(capsys.readouterr().out)["faults"])


def said(capsys: Capture, *words: str) -> tuple[int, str]:
    """Return the output as one line, because a table breaks its sentences."""
    code = main(["model", "check", *words])
    seen = capsys.readouterr()
    assert all(len(line) <= 80 for line in seen.out.splitlines())
    return code, " ".join((seen.out + seen.err).split())


# -- what is well ----------------------------------------------------------------------------


def test_a_plant_without_faults_is_shown_with_its_numbers(mine: Any, capsys: Capture) -> None:
    mine(TANKS)
    slow = ("--set", "controller.horizon_seconds=120", "--set", "adaptation.start=zero")
    code, text = said(capsys, "mine", "--rate", "0.2", *slow)
    assert code == 0
    assert "tanks: equations, linearised at (x_e, u_e); a sample every 5 s" in text
    assert "poles, 1/s: -0.0125, -0.0221; without input it returns" in text
    assert "the inputs move every state" in text
    assert "24 steps (120 s); advised:" in text
    assert "contains h at all 500 sampled points of X and U" in text
    assert "the safe input keeps it in X for 240 s" in text
    for word in ("wrong", "look"):
        assert word not in text


def test_without_a_name_the_plant_of_the_configuration_is_checked(mine: Any, capsys: Capture) -> None:
    mine(TANKS)
    code, found = checked(capsys, "--set", "plant.model=mine", "--rate", "1")
    assert code == 0
    assert found["plant"] == "tanks"


def test_rows_are_listed_and_one_that_x_e_violates_is_a_fault(mine: Any, capsys: Capture) -> None:
    limits = {"x_min": [-1, -1], "x_max": [1, 1], "u_min": [-1], "u_max": [1]}
    rows = {"stop": {"x1": 1.0, "x2": 0.5, "max": 0.7, "priority": 1}}
    mine(Known.from_matrices([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], W=[0.1, 0.1], rows=rows, **limits))
    code, text = said(capsys, "mine")
    assert "stop = 0 at x_e, u_e; limits -inf to 0.7" in text
    code, text = said(capsys, "mine", "--set", "plant.x0=[0.5,0.5]")
    assert "stop = 0.75, the row is [-inf, 0.7]" in text
    code, found = checked(capsys, "mine", "--set", "plant.rows.stop={x1=1.0,max=-0.1}")
    assert code == 2
    assert "row stop is 0 at x_e" in found["faults"][0]


def test_a_plant_whose_poles_are_all_zero_does_not_return(mine: Any, capsys: Capture) -> None:
    limits = {"x_min": [-1, -1], "x_max": [1, 1], "u_min": [-1], "u_max": [1]}
    mine(Known.from_matrices([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], W=[0.1, 0.1], **limits))
    assert "poles, 1/s: 0, 0; without input it does not return" in said(capsys, "mine")[1]


def test_a_state_that_no_sensor_determines_is_a_fault(mine: Any, capsys: Capture) -> None:
    limits = {"x_min": [-1, -1], "x_max": [1, 1], "u_min": [-1], "u_max": [1]}
    mine(Known.from_matrices([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], W=[0.1, 0.1], **limits))
    code, found = checked(
        capsys, "mine", "--set", "estimator.kind=kalman", "--set", 'estimator.measured=["x2"]'
    )
    assert code == 2
    assert found["faults"] == [
        "estimator.measured = x2: these measurements do not determine x1; measure them too"
    ]


def test_the_numbers_of_the_json_are_those_of_the_model(mine: Any, capsys: Capture) -> None:
    mine(PENDULUM)
    code, found = checked(capsys, "mine", *TEN)
    assert code == 0
    assert (found["faults"], found["period"], found["horizon"]) == ([], 0.1, 20)
    np.testing.assert_allclose(found["poles"], [[2.0, 0.0], [-2.0, 0.0]], atol=1e-9)
    np.testing.assert_allclose(
        np.abs(np.linalg.eigvals(np.array(found["A"]) + np.array(found["B"]) @ np.array(found["K"]))) < 1.0,
        True,
    )
    assert (found["x_scale"], found["u_scale"], found["W"]) == ([1.0, 2.0], [3.0], [0.01, 0.1])
    assert found["h_sampled"][1] > 0.5
    assert found["h_bound"] is None


def test_a_proved_bound_contains_the_sampled_h(mine: Any, capsys: Capture) -> None:
    mine(PENDULUM)
    _code, found = checked(capsys, "mine", *TEN, "--prove")
    assert (np.array(found["h_bound"]) >= np.array(found["h_sampled"]) * (1.0 - 1e-9)).all()
    assert found["h_bound"][1] < 1.1 * found["h_sampled"][1]
    wider = ("--set", f"controller.W={[1.01 * bound for bound in found['h_bound']]}")
    _code, found = checked(capsys, "mine", *TEN, "--prove", *wider)
    assert "W" not in found["notes"]
    assert found["W"][1] > found["h_bound"][1]
    _code, found = checked(capsys, "mine", *TEN, "--prove", "--set", "plant.truth.stiffness=5.0")
    assert found["h_bound"] is None
    mine(replace(INTEGRATOR, x_max=np.array([1.0, np.inf])))
    code, text = said(capsys, "mine", "--prove")
    assert code == 0
    assert "h cannot be bounded: integrator: the region has speed" in text


def test_matrices_in_discrete_time_are_checked_at_their_own_rate(mine: Any, capsys: Capture) -> None:
    known = PENDULUM.known()
    A, B = np.array([[1.0, 0.02], [0.08, 1.0]]), np.array([[0.0], [0.02]])
    mine(replace(known, A=A, B=B, period=0.02))
    code, found = checked(capsys, "mine")
    assert (code, found["period"]) == (0, 0.02)
    assert found["A"] == A.tolist()
    # For matrices that are their own truth, h is zero and not shown.
    assert found["h_sampled"] is None
    code, found = checked(capsys, "mine", "--rate", "10")
    assert code == 2
    assert "set rate = 50" in found["faults"][0]


# -- what is worth a look --------------------------------------------------------------------


def beside(**extra: Any) -> Plant:
    """A pendulum, and a temperature that decays without input."""
    fields: dict[str, Any] = {
        "states": ("angle", "rate", "heat"),
        "units": {**PENDULUM.units, "heat": "K"},
        "rhs": lambda x, u: [x[1], 4.0 * ca.sin(x[0]) + u[0], -0.7 * x[2]],
        "parameters": {},
        "equations": None,
        "x_e": np.zeros(3),
        "x_min": np.array([-1.0, -2.0, -300.0]),
        "x_max": np.array([1.0, 2.0, 300.0]),
        "W": np.zeros(3),
        "x0": np.zeros(3),
    }
    return replace(PENDULUM, **{**fields, **extra})


NOTES: dict[str, tuple[Plant | Known, tuple[str, ...], str, str]] = {
    "W that h exceeds": (PENDULUM, TEN, "W", r"h exceeds W somewhere in X and U: .*rate by a factor of \d"),
    "W that h exceeds by far": (
        replace(PENDULUM, W=np.array([0.01, 0.001])),
        TEN,
        "W",
        r"rate by a factor of \d\d0\. Tightening",
    ),
    "W of zero": (beside(), TEN, "W", r"angle by a factor of infinity \(W is 0\)"),
    "x0 outside X": (
        replace(PENDULUM, x0=np.array([1.5, 0.0])),
        TEN,
        "x0",
        r"outside X: angle = 1.5, X is \[-1, 1\]",
    ),
    "a safe input that does not keep it": (
        PENDULUM,
        TEN,
        "safe from x0",
        "under the safe input angle leaves X after 0.7 s",
    ),
    "a rest that the safe input does not hold": (
        PENDULUM,
        TEN,
        "safe from x_e",
        r"under the safe input angle leaves X after 2\.\d s",
    ),
    "a safe input that leads out of the equations": (
        replace(TANKS, safe_input=np.zeros(1), x_min=np.array([-9.0, -9.0])),
        ("--rate", "0.2"),
        "safe from x_e",
        "under the safe input, after .* upper level h1 is",
    ),
    "a state that no input moves": (
        beside(),
        TEN,
        "controllability",
        "no input moves heat; it decays without input",
    ),
    "a state that is hardly moved": (
        replace(TANKS, u_min=TANKS.u_e - 0.1, u_max=TANKS.u_e + 0.1),
        ("--rate", "0.2", "--set", "controller.horizon=2"),
        "controllability",
        "full inputs move h1 by .* h2 by .* only within the horizon; use a longer horizon",
    ),
    "a short horizon": (
        TANKS,
        ("--rate", "0.2", "--set", "controller.horizon=2"),
        "horizon",
        r"2 steps \(10 s\); advised: \d+ steps",
    ),
    "weights in units that hide a state": (
        PENDULUM,
        (*TEN, "--set", "controller.Q=[1e-4, 1]"),
        "weights",
        r"per second: angle 0.0001; torque 9\. .* squares in the plant's units",
    ),
    "a dead time in which an unstable plant runs away": (
        replace(PENDULUM, dead_time=0.6),
        TEN,
        "dead time",
        r"0\.6 s, 6 periods: .* grows by a factor of 3\.3",
    ),
    "states from which nothing can be followed": (
        replace(TANKS, x_min=np.array([-9.0, 1.0])),
        ("--rate", "0.2"),
        "W",
        r"from \d+ of 500 states the motion cannot be computed",
    ),
}


@pytest.mark.parametrize("case", NOTES)
def test_a_note_is_reported_and_is_no_fault(case: str, mine: Any, capsys: Capture) -> None:
    plant, words, subject, sentence = NOTES[case]
    mine(plant)
    code, found = checked(capsys, "mine", *words)
    assert (code, found["faults"]) == (0, [])
    assert re.search(sentence, found["notes"][subject])


# -- what is wrong ---------------------------------------------------------------------------


@pytest.mark.parametrize("case", FAULTY)
def test_every_fault_of_equations_is_named(case: str, mine: Any, capsys: Capture) -> None:
    plant, message = FAULTY[case]
    mine(plant)
    assert re.search(message, refused(capsys, "mine"))


@pytest.mark.parametrize("case", FAULTY_NUMBERS)
def test_every_fault_of_numbers_is_named_though_the_file_raises_while_it_is_read(
    case: str, capsys: Capture
) -> None:
    given, message = FAULTY_NUMBERS[case]
    arguments = {
        **{"a": [[0.0, 1.0], [-2.0, -0.3]], "b": [[0.0], [1.0]], "W": [0.01, 0.1]},
        **{"x_min": [-1.0, -2.0], "x_max": [1.0, 2.0], "u_min": [-3.0], "u_max": [3.0]},
        **given,
    }
    A, B = arguments.pop("a"), arguments.pop("b")
    Path("plant.py").write_text(
        "from math import inf, nan\nfrom lbmpc.plants import Known\n"
        f"PLANT = Known.from_matrices({A!r}, {B!r}, **{arguments!r})\n"
    )
    assert re.search(message, refused(capsys, "plant.py:PLANT"))


def test_all_faults_of_a_file_are_named_at_once(capsys: Capture) -> None:
    Path("plant.py").write_text(
        "from lbmpc.plants import Known\n"
        "PLANT = Known.from_matrices([[0.0]], [[1.0]], W=[-1.0], x_min=[2.0], x_max=[1.0], "
        "performance=(3,), kernel=('w',), poles=(1.0,))\n"
    )
    code, found = checked(capsys, "plant.py:PLANT")
    assert code == 2
    assert [fault.split()[0] for fault in found["faults"]] == [
        *("x_min", "u_min", "W", "poles", "performance", "kernel"),
    ]
    code, text = said(capsys, "plant.py:PLANT")
    assert "performance has 3" in text


MISTAKES: dict[str, tuple[str | None, tuple[str, ...], str]] = {
    "no such file": (None, ("plant.py:PLANT",), "no such file"),
    "no such name": ("x = 1", ("plant.py:PLANT",), "has nothing called 'PLANT'; it has no plant"),
    "no plant": ("PLANT = 1", ("plant.py:PLANT",), "PLANT is no plant but of type int"),
    "not Python": ("PLANT =", ("plant.py:PLANT",), "line 1: not valid Python"),
    "code that fails": ("1 / 0", ("plant.py:PLANT",), "line 1: ZeroDivisionError"),
    "no such plant of Tandem": (None, ("moore_greitser",), "did you mean 'moore_greitzer'?"),
    "no such rate": (None, ("moore_greitzer", "--rate", "-1"), "--rate"),
    "a horizon that leaves no digits": (
        None,
        ("unstable", "--rate", "10", "--set", "controller.horizon=200"),
        "unstable: over a horizon of 200 steps .* Possible: at most 92 steps",
    ),
    "poles that cannot be placed": (
        None,
        ("twice", "--rate", "10"),
        "no stabilising K at a period of 0.1 s: with one input all poles must be different",
    ),
    "no terminal cost": (
        None,
        ("moore_greitzer", "--set", "controller.terminal=published", "--rate", "2"),
        "the terminal cost 'published' at a period of 0.5 s",
    ),
    "weights of another plant": (
        None,
        ("moore_greitzer", "--set", "controller.Q=[1.0]"),
        "controller.Q has 1 entries",
    ),
    "a truth that is none": (
        None,
        ("moore_greitzer", "--set", "plant.truth=plant.py:TRUE"),
        "plant.truth: .*no such file",
    ),
}


@pytest.mark.parametrize("case", MISTAKES)
def test_a_mistake_ends_with_one_message(case: str, monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    text, words, message = MISTAKES[case]
    monkeypatch.setitem(PLANTS, "unstable", replace(PENDULUM, name="unstable"))
    monkeypatch.setitem(PLANTS, "twice", replace(PENDULUM, poles=(-3.0, -3.0)))
    if text is not None:
        Path("plant.py").write_text(text)
    code, seen = said(capsys, *words)
    assert code == 2
    assert re.search(message, seen)
    assert "Traceback" not in seen
