"""The unit that a state or an input is counted in changes no decision: the same plant in others is the same loop."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest

from lbmpc.plants import PLANTS, Plant
from node_runtime.config.sections import load
from run_log.run import Run
from tandem.experiments.simulation.lockstep import simulate
from tests.helpers.rescaled import rescaled

STEPS = 50
ORACLES = ("linear", "l2nw", "dnn", "perfect")
COMPRESSOR = PLANTS["moore_greitzer"]
TWO = (2.0**20, 2.0**-20, 2.0**7, 2.0**-11), (2.0**-17,)
TEN = (1e6, 1e-6, 1e-3, 1e4), (1e5,)
W = COMPRESSOR.W / 20.0
Q, R = np.array([1.0, 2.0, 0.1, 0.01]), np.array([0.5])


@dataclass(frozen=True, eq=False)
class Loop:
    """What a run did, in shares of the half-widths."""

    x: np.ndarray
    u: np.ndarray
    h_hat: np.ndarray
    slack: np.ndarray
    said: list[tuple[object, ...]]
    """Per tick: status, mode, iterations, the row with the slack, what became of hidden weights."""


def run(plant: Plant, x: np.ndarray, u: np.ndarray, oracle: str, steps: int = STEPS) -> Loop:
    """The plant with its states times x, its inputs times u, and with it everything that a configuration has in units."""
    settings = [
        f"controller.oracle={oracle}",
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
