"""A user's plant at the command line: every command refuses a faulty one, and one without bounds works."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from controller_node.build import build_backup, build_controller, build_model
from lbmpc.controller.signals import Observation
from lbmpc.plants import PLANTS, Plant
from lbmpc.solver.constraint_rows import Rows
from node_runtime.config.loading import override
from node_runtime.config.sections import Config
from run_log.reading.reader import read_run
from run_log.replaying.replay import replay
from run_log.writing.save import save
from tandem.cli import main
from tandem.experiments.simulation.lockstep import simulate
from tests.helpers.plants.integrator import INTEGRATOR

ON_TRACK = [
    *("plant.model=integrator", "rate=20", "controller.horizon=10", "controller.solver.compile=never"),
    *("trainer.batch=16", "network.hidden=[8]"),
]
OPTIONS = [word for setting in ON_TRACK for word in ("--set", setting)]
EXPERIMENT = """
name = "own"
title = "A plant that cannot be used"
about = "It has no scale."
steps = 10
[set]
plant = { model = "integrator" }
[[group]]
name = "one"
title = "One"
picture = "trajectories"
[[case]]
name = "linear"
group = "one"
set.controller.oracle = "linear"
"""
COMMANDS = {
    "run": ["run", *OPTIONS, "--seconds", "1"],
    "simulate": ["simulate", *OPTIONS, "--steps", "2"],
    "plant": ["plant", *OPTIONS],
    "controller": ["controller", *OPTIONS],
    "record": ["record", *OPTIONS, "--log", "record.mcap"],
    "sets compute": ["sets", "compute", *OPTIONS, "--out", "sets.json"],
    "experiment": ["experiment", "own.toml", "--out", "out"],
    "replay": ["replay", "good.mcap"],
    "report": ["report", "good.mcap"],
    "config show": ["config", "show", *OPTIONS],
}


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The log of a run, recorded before the plant file became faulty."""
    file = tmp_path_factory.mktemp("log") / "good.mcap"
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(PLANTS, "integrator", INTEGRATOR)
        save(simulate(override(Config(), ON_TRACK), 100), file)
    return file


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_refuses_a_faulty_plant_with_one_message(
    command: str,
    good: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "own.toml").write_text(EXPERIMENT)
    (tmp_path / "good.mcap").symlink_to(good)
    monkeypatch.setitem(PLANTS, "integrator", replace(INTEGRATOR, scale={}, W=[-1.0, 0.2]))
    assert main(COMMANDS[command]) == 2
    said = capsys.readouterr().err
    assert "the plant 'integrator' cannot be used" in said
    assert "W of position is -1: a half-width is at least 0" in said
    assert "x_min of speed is -inf and x_max is inf: give both bounds, or scale=" in said
    assert "Traceback" not in said
    assert {path.name for path in tmp_path.iterdir()} == {"own.toml", "good.mcap"}


@pytest.mark.parametrize("command", [name for name, words in COMMANDS.items() if "--set" in words])
def test_every_command_refuses_a_true_plant_with_unknown_parameters(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(PLANTS, "integrator", INTEGRATOR)
    assert main([*COMMANDS[command], "--set", "plant.truth.frictoin=0.1"]) == 2
    said = capsys.readouterr().err
    assert "plant.truth: integrator has no parameter 'frictoin'; did you mean 'friction'?" in said
    assert not list(tmp_path.iterdir())


UNBOUNDED: dict[str, Plant] = {
    "a speed without bounds": INTEGRATOR,
    "a speed with one bound": replace(INTEGRATOR, x_min=[-1.0, -1.0]),
    "an input without bounds": replace(
        INTEGRATOR, u_min=[-np.inf], u_max=[np.inf], scale={"speed": 2, "push": 2}
    ),
}


@pytest.mark.parametrize(
    "case",
    [
        name if name == "a speed with one bound" else pytest.param(name, marks=pytest.mark.long)
        for name in UNBOUNDED
    ],
)
def test_without_bounds_it_learns_plans_for_silence_and_replays(
    case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(PLANTS, "integrator", UNBOUNDED[case])
    ran = simulate(override(Config(), ON_TRACK), 100)
    verdicts = [result.weights_verdict for result in ran.results]
    assert verdicts.count("adopted") >= 2
    assert {result.mode for result in ran.results} == {"solver"}
    save(ran, tmp_path / "run.mcap")
    found = replay(read_run(tmp_path / "run.mcap"))
    assert found.equal
    assert found.ticks == 100
    assert main(["report", str(tmp_path / "run.mcap")]) == 0


@pytest.mark.parametrize("case", UNBOUNDED)
def test_without_bounds_there_is_a_policy_for_the_controllers_silence(
    case: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(PLANTS, "integrator", UNBOUNDED[case])
    config = override(Config(), ON_TRACK)
    controller, _ = build_controller(config, build_model(config))
    seen = Observation(np.array([-0.9, 0.0]), None, 1, 0, None)
    # Violations of a row count in the state's half-widths, or in the plant's scale if it has a bound on one side only.
    weighed = Rows(controller.problem).penalty.scale
    np.testing.assert_array_equal(weighed[-2:], controller.model.plant.x_scale)
    state, _ = controller.step(controller.initial_state(0), seen)
    policy = controller.backup(build_backup(config, controller.problem), state)
    assert policy is not None
    assert policy.margin == config.controller.backup.margin
    assert np.isfinite(policy.inputs).all()
    assert (np.abs(policy.states[4:, 0]) <= 1.0 - policy.margin + 1e-6).all()


@pytest.mark.parametrize("case", UNBOUNDED)
def test_a_tube_needs_no_bounds(case: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(PLANTS, "integrator", UNBOUNDED[case])
    tube = [
        *ON_TRACK,
        "controller.oracle=linear",
        "controller.tightening=tube",
        "controller.W=[0.01,0.01]",
    ]
    ran = simulate(override(Config(), tube), 20)
    assert {result.mode for result in ran.results} == {"solver"}


def test_certified_sets_of_an_unbounded_plant_are_refused_with_the_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(PLANTS, "integrator", INTEGRATOR)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert main(["sets", "compute", *OPTIONS, "--kind", "given", "--out", str(tmp_path / "sets.json")]) == 3
    assert "not bounded: speed below, speed above" in capsys.readouterr().err
