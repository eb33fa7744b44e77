"""Linearisation, discretisation, K and P."""

from __future__ import annotations

import dataclasses
import warnings

import numpy as np
import pytest

from lbmpc.model import Model, ModelError, build_model
from lbmpc.plants import Truth
from lbmpc.plants.linear_motion import discretise
from lbmpc.plants.moore_greitzer import MOORE_GREITZER as PLANT
from tests.helpers.plants.pendulum import PENDULUM
from tests.helpers.science import compressor


def test_the_jacobian_matches_the_equations() -> None:
    _rest, a, b = PLANT.linearised()
    z, y, r = PLANT.x_e[:3]
    w2, damping = 1000.0, 2 / np.sqrt(2) * 10 * np.sqrt(10)
    expected = [
        [1.5 - 1.5 * z**2, -1, 0, 0],
        [1, -r / (2 * np.sqrt(y)), -np.sqrt(y), 0],
        [0, 0, 0, 1],
        [0, 0, -w2, -damping],
    ]
    np.testing.assert_allclose(a, expected, atol=1e-12)
    np.testing.assert_allclose(b.ravel(), [0, 0, 0, w2])


@pytest.mark.parametrize("period", [0.05, 0.001])
def test_a_part_of_a_period_is_discretised_exactly(period: float) -> None:
    model = compressor(period)
    directions = np.eye(model.d + model.m)
    for share in (0.0, 1e-6, 0.1, 0.37, 1.0, 1.9, 2.0, 3.5):
        exact = np.hstack(discretise(model.plant.A, model.plant.B, share * period))
        quick = [model.ahead(way[: model.d], way[model.d :], share * period) for way in directions]
        np.testing.assert_allclose(
            np.transpose(quick), exact, rtol=0, atol=1e-13 * max(1.0, np.abs(exact).max())
        )


def test_discretisation_is_exact() -> None:
    model = compressor(0.05)
    _rest, a, b = PLANT.linearised()
    x, u = np.array([0.1, -0.2, 0.3, 2.0]), np.array([0.4])
    fine = x.copy()
    steps = 2000
    h = 0.05 / steps
    for _ in range(steps):  # Runge-Kutta 4 on the linear equations
        k1 = a @ fine + b @ u
        k2 = a @ (fine + h / 2 * k1) + b @ u
        k3 = a @ (fine + h / 2 * k2) + b @ u
        fine = fine + h / 6 * (k1 + 2 * k2 + 2 * k3 + a @ (fine + h * k3) + b @ u)
    np.testing.assert_allclose(model.A @ x + model.B @ u, fine, atol=1e-10)


def test_K_matches_the_published_example() -> None:
    # Aswani et al. (2013) at T = 0.01 s, and the same continuous-time poles at 0.05 s.
    np.testing.assert_allclose(compressor(0.01).K[0], [-3.0742, 2.0958, 0.1194, -0.00895], atol=5e-5)
    np.testing.assert_allclose(compressor(0.05).K[0], [-2.7709, 1.9127, 0.1605, 0.00005], atol=5e-5)


def lqr_gain(model: Model) -> np.ndarray:
    """Return the greedy gain for |x|_P^2 as cost-to-go, (m, d)."""
    A, B, P = model.A, model.B, model.P
    return -np.linalg.solve(model.R + B.T @ P @ B, B.T @ P @ A)


def decrease(model: Model, gain: np.ndarray) -> np.ndarray:
    """Return P - A_f'P A_f - (Q + K_f'R K_f)."""
    closed = model.A + model.B @ gain
    return model.P - closed.T @ model.P @ closed - model.Q - gain.T @ model.R @ gain


def least(matrix: np.ndarray) -> float:
    return float(np.linalg.eigvalsh(matrix).min())


def test_weights_are_per_second() -> None:
    """The cost is an integral, so the cost of a motion does not depend on the sampling rate."""
    for period in (0.05, 0.01):
        model = build_model(PLANT, period, Q=np.array([1.0, 2.0, 0.5, 0.0]), R=np.array([3.0]))
        np.testing.assert_allclose(np.diag(model.Q), period * np.array([1.0, 2.0, 0.5, 0.0]))
        np.testing.assert_allclose(model.R, [[3.0 * period]])
    coarse, fine = (build_model(PLANT, period, Q=np.array([1.0, 1.0, 1.0, 0.0])) for period in (0.002, 0.001))
    np.testing.assert_allclose(coarse.P[:2, :2], fine.P[:2, :2], rtol=2e-3)


def test_the_default_P_is_the_cost_of_the_lqr() -> None:
    model = compressor()
    np.testing.assert_allclose(decrease(model, lqr_gain(model)), 0.0, atol=1e-10)
    # No other gain costs less; the placed K costs more.
    assert least(-decrease(model, model.K)) > -1e-10
    assert least(decrease(model, model.K)) < -0.1


def test_P_can_be_the_cost_of_K() -> None:
    model = build_model(PLANT, 0.05, terminal="lyapunov")
    np.testing.assert_allclose(decrease(model, model.K), 0.0, atol=1e-10)
    assert least(model.P - compressor().P) > 0


def test_the_published_P_is_not_multiplied_by_the_period() -> None:
    """It belongs to (A + BK, B) with weights of 1 per sample, as in the reimplementation of Aswani et al. at 100 Hz."""
    model = build_model(PLANT, 0.01, terminal="published")
    closed, B, P = model.closed_loop, model.B, model.P
    gain = np.linalg.solve(np.eye(1) + B.T @ P @ B, B.T @ P @ closed)
    np.testing.assert_allclose(closed.T @ P @ (closed - B @ gain) + np.eye(4), P, rtol=1e-7)
    # Its input is c = v - K x, so P exceeds the cost after N.
    assert least(decrease(model, lqr_gain(model))) > 0
    assert least(decrease(model, model.K)) < -1.0


def test_an_invalid_terminal_cost_is_refused_with_a_remedy() -> None:
    with pytest.raises(
        ModelError, match=r"'published' at a period of 0\.5 s does not bound .* use 'riccati'"
    ):
        build_model(PLANT, 0.5, terminal="published")


def test_numbers_without_a_valid_P_are_refused() -> None:
    """The plant grows by e^12 to e^15 per period, and the solution of the equations is not positive."""
    for growth in (120.0, 150.0):
        steep = dataclasses.replace(
            PENDULUM,
            rhs=lambda x, u, a=growth: [a * x[0] + x[1], a * x[1] + u[0]],
            x0=np.zeros(2),
            poles=(-1.0, -2.0),
        )
        for terminal, other in (("riccati", "lyapunov"), ("lyapunov", "riccati")):
            with (
                warnings.catch_warnings(action="ignore"),
                pytest.raises(ModelError, match=f"'{terminal}' at .* use '{other}'"),
            ):
                build_model(steep, 0.1, terminal=terminal)


def test_without_poles_K_is_the_lqr_gain() -> None:
    model = build_model(dataclasses.replace(PLANT, poles=None), 0.05)
    assert np.abs(np.linalg.eigvals(model.closed_loop)).max() < 1
    np.testing.assert_allclose(lqr_gain(model), model.K, atol=1e-7)


def test_a_point_that_is_not_an_equilibrium_is_refused() -> None:
    moved = dataclasses.replace(PLANT, x_e=PLANT.x_e + np.array([0.1, 0, 0, 0]))
    with pytest.raises(ModelError, match="not an equilibrium"):
        build_model(moved, 0.05)


def test_weights_of_the_wrong_length_are_refused() -> None:
    with pytest.raises(ModelError, match="Q has 3 weights"):
        build_model(PLANT, 0.05, Q=np.ones(3))


def test_the_response_to_one_piece_is_B_u_and_pieces_compose() -> None:
    model, u = compressor(), np.array([0.3])
    np.testing.assert_allclose(model.within.answer(((0.05, u),)), model.B @ u, atol=1e-15)
    np.testing.assert_allclose(model.within.answer(((0.02, u), (0.03, u))), model.B @ u, atol=1e-14)


def test_a_label_with_pieces_does_not_depend_on_the_commands_timing() -> None:
    """Near the equilibrium h is tiny. With the mean input, a late command would look like an h many times larger."""
    model, truth = compressor(), Truth(PLANT)
    early, late = np.array([0.02]), np.array([-0.05])
    x = np.array([0.01, -0.01, 0.0, 0.0])
    middle = truth.step(x + PLANT.x_e, early + PLANT.u_e, 0.01)
    after = truth.step(middle, late + PLANT.u_e, 0.04) - PLANT.x_e
    mean = 0.2 * early + 0.8 * late
    exact = model.label(x, mean, after, ((0.01, early), (0.04, late)))
    naive = model.label(x, mean, after)
    assert np.abs(exact).max() < 2e-5
    assert np.abs(naive).max() > 0.05
