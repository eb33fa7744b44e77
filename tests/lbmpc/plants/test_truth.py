"""The compressor's true motion."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from lbmpc.plants import PlantError, Truth, get_plant
from lbmpc.plants.moore_greitzer import MOORE_GREITZER as PLANT

RNG = np.random.default_rng(1)


def by_hand(x: np.ndarray, u: float) -> list[float]:
    """The paper's equations with sqrt(y), written independently of CasADi."""
    z, y, r, rdot = x
    omega, zeta = 10 * np.sqrt(10), 1 / np.sqrt(2)
    return [
        -y + 1 + 1.5 * z - 0.5 * z**3,
        z + 1 - r * np.sqrt(y),
        rdot,
        omega**2 * (u - r) - 2 * zeta * omega * rdot,
    ]


@pytest.mark.parametrize("period", [0.001, 0.05])
def test_a_step_is_within_1e_9_of_a_tight_reference(period: float) -> None:
    truth = Truth(PLANT)
    for _ in range(5):
        x = RNG.uniform(PLANT.x_min, PLANT.x_max)
        u = RNG.uniform(PLANT.u_min, PLANT.u_max)
        reference = solve_ivp(
            lambda _t, s, u=u: by_hand(s, u[0]), (0, period), x, method="Radau", rtol=3e-14, atol=1e-15
        )
        assert np.abs(truth.step(x, u, period) - reference.y[:, -1]).max() < 1e-9


def test_a_short_period_takes_one_step_with_the_same_tolerance() -> None:
    truth = Truth(PLANT)
    for _ in range(20):
        x, u = RNG.uniform(PLANT.x_min, PLANT.x_max), RNG.uniform(PLANT.u_min, PLANT.u_max)
        whole = truth._in_one(x, u, 0.001)
        assert whole is not None
        assert np.abs(whole - truth._in_many(x, u, 0.001)).max() < 1e-12
        # One step is not enough, as its error estimate shows.
        assert truth._in_one(x, u, 0.05) is None


def test_a_step_out_of_the_domain_is_not_taken_in_one() -> None:
    x = np.array([-3.0, 1e-4, 1.0, 0.0])
    assert Truth(PLANT)._in_one(x, PLANT.u_e, 0.001) is None


def test_the_equilibrium_stays_where_it_is() -> None:
    assert np.abs(Truth(PLANT).step(PLANT.x_e, PLANT.u_e, 10.0) - PLANT.x_e).max() < 1e-4
    # The paper's rounded values, (0.5, 1.6875, 1.1547, 0), are the same point.
    assert np.abs(by_hand(np.array([0.5, 1.6875, 1.1547, 0.0]), 1.1547)).max() < 1e-6


@pytest.mark.parametrize("y", [-0.1, 0.0])
def test_a_nonpositive_pressure_is_reported(y: float) -> None:
    with pytest.raises(PlantError, match="pressure y is"):
        Truth(PLANT).step(np.array([0.1, y, 1.0, 0.0]), PLANT.u_e, 0.05)


def test_a_pressure_that_reaches_zero_within_a_step_is_reported() -> None:
    # A reversed flow below -1 empties the plenum.
    with pytest.raises(PlantError, match=r"pressure y is|not finite|cannot be integrated") as caught:
        Truth(PLANT).step(np.array([-3.0, 0.05, 1.0, 0.0]), PLANT.u_e, 0.05)
    assert "nan" not in str(caught.value)


def test_an_unknown_plant_gives_the_nearest_name() -> None:
    with pytest.raises(KeyError, match="did you mean 'moore_greitzer'"):
        get_plant("more_greitzer")
