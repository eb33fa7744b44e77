"""The plant's own motion over part of a period: accurate in the domain of the equations, None outside."""

from __future__ import annotations

import numpy as np
import pytest

from lbmpc.model import Model, build_model
from lbmpc.plants import get_plant
from lbmpc.plants.truth import Truth
from lbmpc.sets.motion import OfEquations
from tests.helpers.plants.pendulum import pendulum, two_inputs

COMPRESSOR = build_model(get_plant("moore_greitzer"), 0.05)


@pytest.mark.parametrize("model", [COMPRESSOR, pendulum(), two_inputs()], ids=lambda one: one.plant.name)
def test_the_prediction_equals_the_true_motion_over_half_a_period(model: Model) -> None:
    plant, rng = model.plant, np.random.default_rng(0)
    motion, truth = OfEquations(model, model.equations), Truth(model.equations)
    for _ in range(50):
        x, u = rng.uniform(plant.x_min, plant.x_max), rng.uniform(plant.u_min, plant.u_max)
        seconds = rng.uniform(0.0, 0.5 * model.period)
        found = motion.after(x - plant.x_e, u - plant.u_e, seconds)
        assert found is not None
        error = (found + plant.x_e - truth.step(x, u, seconds)) / plant.x_scale
        assert np.abs(error).max() < 1e-8


def test_outside_the_domain_there_is_no_prediction() -> None:
    plant, motion = COMPRESSOR.plant, OfEquations(COMPRESSOR, COMPRESSOR.equations)
    without_pressure = np.array([0.5, -0.1, 1.0, 0.0])
    assert motion.after(without_pressure - plant.x_e, np.zeros(1), 0.01) is None
    assert motion.after(np.array([1e6, 0.0, 0.0, 0.0]), np.zeros(1), 0.01) is None
    # The next call is not affected.
    assert motion.after(np.zeros(4), np.zeros(1), 0.01) == pytest.approx(np.zeros(4), abs=1e-6)
