"""The analysis of a model, compared with hand computations."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from examples.tanks.tanks import TANKS
from lbmpc.analysis import (
    SETTLED,
    growth,
    poles,
    reach,
    sample_disturbance,
    settling_steps,
    under_safe_input,
)
from lbmpc.model import Model, ModelError, build_model, longest_horizon, require_horizon
from lbmpc.plants import Truth
from tests.helpers.plants.pendulum import PENDULUM, pendulum


def with_heat() -> Model:
    """A pendulum, and a state that the torque does not move."""
    beside = replace(
        PENDULUM,
        states=("angle", "rate", "heat"),
        units={**PENDULUM.units, "heat": "K"},
        rhs=lambda x, u: [x[1], 4.0 * ca.sin(x[0]) + u[0], -0.7 * x[2]],
        parameters={},
        equations=None,
        x_e=np.zeros(3),
        x_min=np.array([-1.0, -2.0, -300.0]),
        x_max=np.array([1.0, 2.0, 300.0]),
        W=np.zeros(3),
        x0=np.zeros(3),
    )
    return build_model(beside, 0.1)


def test_poles_are_those_of_the_equations() -> None:
    model = pendulum()
    np.testing.assert_allclose(poles(model.A, 0.1), [2.0, -2.0], rtol=1e-9)
    complex_pair = np.array([[0.0, 1.0], [-1.0, 0.0]])
    np.testing.assert_allclose(poles(complex_pair, 1.0), [0.5j * np.pi, -0.5j * np.pi], atol=1e-12)
    assert poles(np.zeros((1, 1)), 1.0)[0].real == -np.inf


def test_reach_equals_the_effect_of_full_inputs() -> None:
    """The best input for a state follows the sign of its response."""
    model = pendulum()
    responses = [np.linalg.matrix_power(model.A, k) @ model.B for k in range(20)]
    for i in range(2):
        x = np.zeros(2)
        for k in range(20):
            x = model.A @ x + model.B[:, 0] * 3.0 * np.sign(responses[19 - k][i, 0])
        assert reach(model, 20)[i] == pytest.approx(x[i] / model.plant.x_scale[i])
    assert reach(with_heat(), 20)[2] == pytest.approx(0.0, abs=1e-12)


def test_growth_and_longest_horizon_match_the_controllers_limit() -> None:
    model = pendulum()
    assert growth(model, 60) == pytest.approx(np.exp(2.0 * 6.0))
    most = longest_horizon(model)
    assert most is not None
    require_horizon(model, most)
    with pytest.raises(ModelError):
        require_horizon(model, most + 1)
    assert longest_horizon(build_model(TANKS, 5.0)) is None
    assert growth(build_model(TANKS, 5.0), 100) == 1.0


def test_after_the_settling_time_every_corner_is_near_rest_and_before_it_one_is_not() -> None:
    model = pendulum()
    steps = settling_steps(model)

    def farthest(count: int) -> float:
        power = np.linalg.matrix_power(model.closed_loop, count)
        corners = np.array([[1.0, 2.0], [1.0, -2.0]]) @ power.T
        return float(np.abs(corners / model.plant.x_scale).max())

    assert farthest(steps) <= SETTLED < farthest(steps - 1)


def test_the_largest_disturbance_is_found_at_the_corners() -> None:
    """h of a pendulum over a period is about 4 (sin th - th) T, and is largest for |th| = 1."""
    model = pendulum()
    found = sample_disturbance(model, Truth(PENDULUM).step, 400, np.random.default_rng(0))
    assert found.largest[1] == pytest.approx(4.0 * (1.0 - np.sin(1.0)), rel=0.45)
    assert abs(found.x[1, 0]) == 1.0
    again = Truth(PENDULUM).step(found.x[1], found.u[1], 0.1) - model.step(found.x[1], found.u[1])
    assert abs(again[1]) / 0.1 == pytest.approx(found.largest[1], rel=1e-9)
    assert (found.samples, found.lost) == (400, 0)


def test_states_outside_the_equations_domain_are_counted() -> None:
    deep = replace(TANKS, x_min=np.array([-2.0, 1.0]))
    found = sample_disturbance(build_model(TANKS, 5.0), Truth(TANKS).step, 50, np.random.default_rng(0))
    assert found.lost == 0
    model = build_model(deep, 5.0)
    assert sample_disturbance(model, Truth(deep).step, 50, np.random.default_rng(0)).lost > 5


def test_the_safe_input_holds_tanks_but_not_a_pendulum() -> None:
    tanks = build_model(TANKS, 5.0)
    assert under_safe_input(tanks, Truth(TANKS).step, TANKS.x0, 100.0).left == ""
    kept = under_safe_input(pendulum(), Truth(PENDULUM).step, PENDULUM.x0, 5.0)
    assert kept.left == "angle"
    # th grows as 0.5 cosh 2t, and with the sine it exceeds 1 rad between 0.6 and 0.7 s.
    assert kept.seconds == pytest.approx(0.7)
    held = replace(PENDULUM, safe_gain=np.array([[-8.0, -4.0]]))
    model = build_model(held, 0.1)
    assert under_safe_input(model, Truth(held).step, PENDULUM.x0, 5.0).left == ""


def test_the_reason_is_given_if_the_motion_cannot_be_computed() -> None:
    dry = replace(TANKS, safe_input=np.zeros(1), x_min=np.array([-5.0, -5.0]), positive=TANKS.positive)
    kept = under_safe_input(build_model(dry, 5.0), Truth(dry).step, TANKS.x0, 5000.0)
    assert "upper level h1" in kept.left
