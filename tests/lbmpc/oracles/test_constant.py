"""The constant oracle: limits of its filter, invalid labels, and the rest of the closed loop."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lbmpc.controller.signals import Observation
from lbmpc.controller.step import Controller
from lbmpc.model import build_model
from lbmpc.oracles import ConstantOracle, LinearOracle, Oracle
from lbmpc.problem import build_problem
from lbmpc.solver.gauss_newton import Solver
from node_runtime.config.loading import load
from node_runtime.config.strict import ConfigError
from tandem.experiments.simulation.lockstep import follow
from tests.helpers.plants.integrator import INTEGRATOR

LABELS = st.lists(st.lists(st.floats(-1e3, 1e3), min_size=2, max_size=2), min_size=1, max_size=20)
X, U = np.zeros(2), np.zeros(1)


def filtered(gain: float, labels: list[list[float]]) -> np.ndarray:
    oracle = ConstantOracle(2, 1, gain)
    state = oracle.initial_state(np.random.default_rng(0))
    for h in labels:
        state = oracle.learn(state, X, U, np.array(h))
    return oracle.estimate(state, X, U)


@given(LABELS)
def test_with_a_gain_of_1_h_hat_is_the_last_label(labels: list[list[float]]) -> None:
    np.testing.assert_array_equal(filtered(1.0, labels), labels[-1])


@given(st.floats(1e-3, 1.0), LABELS)
def test_h_hat_stays_in_the_hull_of_zero_and_the_labels(gain: float, labels: list[list[float]]) -> None:
    seen = np.array([[0.0, 0.0], *labels])
    h_hat, slack = filtered(gain, labels), 1e-12 * np.abs(seen).max(axis=0)
    assert (h_hat >= seen.min(axis=0) - slack).all()
    assert (h_hat <= seen.max(axis=0) + slack).all()


@given(st.floats(0.05, 1.0), st.lists(st.floats(-10, 10), min_size=2, max_size=2))
def test_a_constant_label_is_the_fixed_point(gain: float, h: list[float]) -> None:
    for n in (1, 5, 40):
        left = np.array(h) - filtered(gain, [h] * n)
        np.testing.assert_allclose(left, (1 - gain) ** n * np.array(h), atol=1e-12)


@pytest.mark.parametrize("gain", [0.0, -0.1, 1.001])
def test_a_gain_outside_its_range_is_refused(gain: float) -> None:
    with pytest.raises(ConfigError, match=r"constant\.gain"):
        load(None, [f"constant.gain={gain}"])


def test_a_lock_step_run_filters_with_the_configured_gain() -> None:
    settings = ["controller.oracle=constant", "constant.gain=0.2", "controller.solver.compile=never"]
    run = follow(load(None, [*settings, "controller.horizon=10"]), 12).run
    h_hat = np.zeros(4)
    for result in run.results:
        if result.h is not None:
            np.testing.assert_allclose(result.h_hat, h_hat, atol=1e-15)
            h_hat = h_hat + 0.2 * (np.array(result.h) - h_hat)
    assert np.abs(h_hat).max() > 1e-3


# -- a plant that differs from its model by a constant push -----------------------------------------------------------

# The input has a low cost, so that an offset cannot come from the cost of the input.
MODEL = build_model(INTEGRATOR, 0.1, None, np.array([0.01]))
PUSH = MODEL.B @ [0.3]


def controller(oracle: Oracle) -> Controller:
    problem = build_problem(MODEL, oracle, 20, "first_step")
    return Controller(problem, Solver(problem))


def rest(oracle: Oracle, steps: int = 250) -> tuple[np.ndarray, np.ndarray]:
    """Return the rest of x, and h_hat at it."""
    loop, x, applied = controller(oracle), np.array([-0.5, 0.0]), None
    state = loop.initial_state(0)
    for seq in range(steps):
        state, result = loop.step(state, Observation(x, applied, 1, seq, None))
        applied, before = result.plan[0], x
        x = MODEL.step(x, applied) + PUSH
    np.testing.assert_allclose(x, before, atol=1e-7)
    return x, oracle.estimate(state.oracle, x, U)


class Told(ConstantOracle):
    """Knows the push from the start."""

    def initial_state(self, rng: np.random.Generator) -> dict[str, np.ndarray]:
        return {"h_hat": PUSH}


@pytest.mark.parametrize("gain", [0.2, 0.5, 1.0])
def test_the_loop_rests_at_the_target_as_with_a_known_push(gain: float) -> None:
    x, h_hat = rest(ConstantOracle(2, 1, gain))
    np.testing.assert_allclose(h_hat, PUSH, atol=1e-7)
    np.testing.assert_allclose(x, rest(Told(2, 1, gain))[0], atol=1e-7)
    assert np.linalg.norm(x) < 0.02 * np.linalg.norm(rest(LinearOracle(2, 1))[0])


def test_nonfinite_labels_are_ignored() -> None:
    loop = controller(ConstantOracle(2, 1, 0.5))
    state, _ = loop.step(loop.initial_state(0), Observation(np.array([0.1, 0.0]), None, 1, 0, None))
    state, result = loop.step(state, Observation(np.array([0.1, 0.01]), np.zeros(1), 1, 1, None))
    assert result.label is not None
    learned = state.oracle["h_hat"]
    assert learned.any()
    for bad in (np.nan, np.inf, 1e300):
        after, result = loop.step(state, Observation(np.array([0.1, bad]), np.zeros(1), 1, 2, None))
        assert result.label is None
        np.testing.assert_array_equal(after.oracle["h_hat"], learned)
