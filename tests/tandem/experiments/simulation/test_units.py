"""The units of states and inputs change no decision: the same plant in other units gives the same loop."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest

from lbmpc.plants import PLANTS, Plant
from node_runtime.config.loading import load
from run_log.run import Run
from tandem.experiments.simulation.lockstep import simulate
from tests.helpers.plants.pendulum import PENDULUM
from tests.helpers.rescaled import rescaled

STEPS = 50
ORACLES = ("linear", "constant", "l2nw", "dnn", "dnn adaptation.law=kalman", "perfect")
"""Oracles, each with its settings."""
COMPRESSOR = PLANTS["moore_greitzer"]
TWO = (2.0**20, 2.0**-20, 2.0**7, 2.0**-11), (2.0**-17,)
TEN = (1e6, 1e-6, 1e-3, 1e4), (1e5,)
W = COMPRESSOR.W
Q, R = np.array([1.0, 2.0, 0.1, 0.01]), np.array([0.5])


@dataclass(frozen=True, eq=False)
class Loop:
    """Results of a run, in shares of the half-widths."""

    x: np.ndarray
    u: np.ndarray
    h_hat: np.ndarray
    slack: np.ndarray
    said: list[tuple[object, ...]]
    """Per tick: status, mode, iterations, the row with the slack, and the verdict on hidden weights."""


def run(plant: Plant, x: np.ndarray, u: np.ndarray, oracle: str, steps: int = STEPS) -> Loop:
    """The plant with its states times x and its inputs times u, and the configuration's W, Q and R with it."""
    settings = [
        *f"controller.oracle={oracle}".split(),
        f"controller.W={(W * x).tolist()}",
        f"controller.Q={(Q / x**2).tolist()}",
        f"controller.R={(R / u**2).tolist()}",
        "controller.solver.compile=never",
        "trainer.steps=50",
    ]
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(PLANTS, plant.name, rescaled(plant, x, u))
        return loop(simulate(load(None, settings), steps))


def loop(run: Run) -> Loop:
    plant = PLANTS[run.config.plant.model]
    results = run.results
    return Loop(
        (np.array([state.x for state in run.plant_states]) - plant.x_e) / plant.x_scale,
        (np.array([command.u for command in run.commands]) - plant.u_e) / plant.u_scale,
        np.array([r.h_hat for r in results if r.h_hat is not None]) / plant.x_scale,
        np.array([r.slack for r in results]),
        [(r.status, r.mode, r.iterations, r.slack_row, r.weights_verdict) for r in results],
    )


@cache
def as_it_is(oracle: str) -> Loop:
    return run(COMPRESSOR, np.ones(4), np.ones(1), oracle)


@pytest.mark.parametrize("oracle", ORACLES)
def test_in_units_of_powers_of_two_every_number_is_the_same(oracle: str) -> None:
    here, there = as_it_is(oracle), run(COMPRESSOR, *map(np.array, TWO), oracle)
    assert here.said == there.said
    for name in ("x", "u", "h_hat", "slack"):
        np.testing.assert_array_equal(getattr(here, name), getattr(there, name), err_msg=name)


@pytest.mark.parametrize("oracle", ORACLES)
def test_in_units_of_powers_of_ten_the_loop_is_the_same_up_to_rounding(oracle: str) -> None:
    here, there = as_it_is(oracle), run(COMPRESSOR, *map(np.array, TEN), oracle)
    assert here.said == there.said
    for name in ("x", "u", "h_hat", "slack"):
        np.testing.assert_allclose(getattr(there, name), getattr(here, name), rtol=0, atol=1e-6, err_msg=name)


@pytest.mark.parametrize("oracle", ["linear", "dnn"])
def test_a_violated_state_constraint_has_the_same_share_in_any_units(oracle: str) -> None:
    """From a state where X cannot be kept, the penalty decides, and the row with the largest share is named."""
    low = [0.1, 1.2, COMPRESSOR.x0[2], 0.0]
    plant = replace(COMPRESSOR, x0=np.array(low))
    here, there = run(plant, np.ones(4), np.ones(1), oracle, 20), run(plant, *map(np.array, TWO), oracle, 20)
    assert here.slack.max() > 0.01
    assert here.said == there.said
    np.testing.assert_array_equal(there.slack, here.slack)
    np.testing.assert_array_equal(there.u, here.u)


def test_bounds_of_a_millionth_are_kept_as_well_as_bounds_of_one() -> None:
    """A pendulum whose X is +-1e-6 wide and whose torque goes to 3e6, with the terminal set of its tube."""
    pendulum = replace(PENDULUM, x0=np.array([0.25, -0.5]))
    x, u = np.array([1e-6, 0.5e-6]), np.array([1e6])
    runs = [
        simulate_pendulum(pendulum, factors, inputs) for factors, inputs in ((np.ones(2), np.ones(1)), (x, u))
    ]
    assert runs[0].said == runs[1].said
    assert {said[0] for said in runs[1].said} == {"converged"}
    assert np.abs(runs[1].x).max() <= 1.0
    np.testing.assert_allclose(runs[1].x, runs[0].x, rtol=0, atol=1e-7)


def simulate_pendulum(plant: Plant, x: np.ndarray, u: np.ndarray) -> Loop:
    settings = [
        "plant.model=pendulum",
        "rate=10",
        "controller.oracle=linear",
        "controller.horizon=15",
        "controller.tightening=tube",
        f"controller.W={(np.array([0.01, 0.1]) * x).tolist()}",
        f"controller.Q={(1.0 / x**2).tolist()}",
        f"controller.R={(0.1 / u**2).tolist()}",
        "controller.solver.compile=never",
    ]
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(PLANTS, "pendulum", rescaled(plant, x, u))
        return loop(simulate(load(None, settings), 25))
