"""Conditions for a construction of sets, and its error messages."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lbmpc.model import build_model
from lbmpc.sets.certificate import Kind
from lbmpc.sets.check import check
from lbmpc.sets.construct import construct
from lbmpc.sets.geometry.polytope import EmptySetError, SetError
from tests.helpers.plants.pendulum import PENDULUM, pendulum, two_inputs

MODEL = pendulum()
START = np.array([0.62, 0.0])


def test_a_missing_trajectory_is_reported() -> None:
    with pytest.raises(EmptySetError, match=r"kept in X for \d+ steps"):
        construct(MODEL, "given", START, W=np.array([0.05, 1.0]))
    with pytest.raises(SetError, match="no trajectory of the true plant"):
        construct(MODEL, "regions", np.array([0.99, 1.9]))


def test_a_state_that_decays_within_a_period_needs_no_bounds() -> None:
    """With two inputs the elimination once failed with "unbounded in variable 0: give it bounds"."""
    fast = replace(
        two_inputs().equations,
        name="fast",
        rhs=lambda x, u: [-1000.0 * x[0] + u[0], x[1] + u[1]],
    )
    certificate = construct(build_model(fast, 0.1), "given", np.zeros(2), W=np.array([0.01, 0.01]))
    assert check(certificate).ok


@pytest.mark.parametrize(
    ("changes", "open_end"),
    [
        ({"x_min": np.array([-1.0, -np.inf]), "x_max": np.array([1.0, np.inf])}, "rate below, rate above"),
        ({"x_max": np.array([1.0, np.inf])}, "rate above"),
        ({"u_min": np.array([-np.inf])}, "torque below"),
    ],
)
@pytest.mark.parametrize("kind", ["box", "regions", "given"])
def test_the_error_for_an_unbounded_plant_names_the_bounds(changes: dict, open_end: str, kind: Kind) -> None:
    plant = replace(PENDULUM, scale={"rate": 2.0, "torque": 3.0}, **changes)
    with pytest.raises(SetError, match=rf"not bounded: {open_end}\. .*Give the plant such bounds") as refused:
        construct(build_model(plant, 0.1), kind, np.zeros(2))
    assert "`scale` is not a bound" in str(refused.value)
