"""A plant whose controller has matrices only, in lock-step. The truth is given by equations, by matrices or with a
wind."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest

from examples.quadrotor.quadrotor import QUADROTOR
from lbmpc.plants import PLANTS, Description, Known
from lbmpc.plants.linear_motion import discretise
from node_runtime.config.loading import load
from node_runtime.config.sections import Config
from node_runtime.config.strict import ConfigError
from protocol import codec
from run_log.run import Run
from tandem.experiments.simulation.faults import Faults
from tandem.experiments.simulation.lockstep import follow, simulate
from tests.helpers.plants.pendulum import PENDULUM

PERIOD = 0.1
SETTINGS = [
    *("rate=10", "controller.oracle=linear", "controller.horizon=10", "controller.solver.compile=never"),
]


def matrices(period: float | None = None) -> Known:
    """Return the matrices of the pendulum with all its other fields."""
    _rest, a, b = PENDULUM.linearised()
    if period is not None:
        a, b = discretise(a, b, period)
    shared = {one.name: getattr(PENDULUM, one.name) for one in fields(Description)}
    return Known.from_matrices(a, b, **(shared | {"name": "matrices", "period": period}))


@pytest.fixture(autouse=True)
def plants(monkeypatch: pytest.MonkeyPatch) -> None:
    sampled = replace(matrices(PERIOD), name="sampled")
    windy = replace(QUADROTOR.varied(wind=2.0).resting_near(), name="windy")
    for plant in (PENDULUM, matrices(), sampled, QUADROTOR, windy):
        monkeypatch.setitem(PLANTS, plant.name, plant)


def configured(model: str, *settings: str) -> Config:
    return load(None, [f"plant.model={model}", *SETTINGS, *settings])


def said(run: Run) -> tuple[list[bytes], list[bytes]]:
    """Return the encoded messages of plant and controller."""
    return [codec.encode(state) for state in run.plant_states], [codec.encode(one) for one in run.commands]


@pytest.mark.parametrize("seconds", [0.0, 0.03])
def test_matrices_control_as_the_equations_that_they_come_from(seconds: float) -> None:
    late = Faults(command_seconds=seconds)
    equations = follow(configured("pendulum"), 40, late).run
    numbers = follow(configured("matrices", "plant.truth=pendulum"), 40, late).run
    assert said(numbers) == said(equations)
    labels = [sample.h for sample in numbers.samples]
    assert len(labels) >= 38
    assert np.abs(labels).max() > 1e-3


def test_sampled_matrices_control_almost_as_those_that_they_were_sampled_from() -> None:
    late = Faults(command_seconds=0.03)
    here = follow(configured("sampled", "plant.truth=pendulum"), 40, late).run
    there = follow(configured("pendulum"), 40, late).run
    ours, theirs = (np.array([state.x for state in run.plant_states]) for run in (here, there))
    np.testing.assert_allclose(ours, theirs, atol=1e-6)


@pytest.mark.parametrize("model", ["matrices", "sampled"])
def test_matrices_that_are_their_own_truth_leave_no_h(model: str) -> None:
    run = follow(configured(model), 40, Faults(command_seconds=0.03)).run
    labels = np.array([sample.h for sample in run.samples])
    assert len(labels) >= 38
    assert np.abs(labels).max() < 1e-12


def test_features_that_need_equations_say_so() -> None:
    with pytest.raises(ConfigError, match=r"perfect.* needs the equations of the true plant"):
        simulate(configured("matrices", "controller.oracle=perfect"), 1)
    with pytest.raises(ConfigError, match=r"are given for a period of 0.1 s"):
        simulate(configured("sampled", "rate=20"), 1)


def test_a_known_wind_leaves_no_offset() -> None:
    """The linear oracle does not learn. With the wind in the model the plant still settles at its target."""
    weights = "controller.Q=[25.0, 25.0, 10.0, 1.0, 1.0, 0.1]", "controller.R=[0.7, 0.7]"
    start = "plant.x0=[-0.5,0,0,0,0,0]"
    ends = {}
    for model in ("quadrotor", "windy"):
        config = configured(model, start, *weights, "rate=20", "controller.horizon=15", "plant.truth=windy")
        ends[model] = simulate(config, 80).plant_states[-1].x[0]
    assert ends["quadrotor"] > 0.05
    assert abs(ends["windy"]) < 0.01
