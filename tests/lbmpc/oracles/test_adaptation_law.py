"""Lemma 1 of the paper, checked on synthetic plants with known ideal weights W*."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from lbmpc.oracles import DnnOracle
from lbmpc.oracles.dnn.adaptation_law import project_columns
from lbmpc.oracles.dnn.evidence import Evidence, weights
from lbmpc.oracles.dnn.kalman_law import Kalman
from tests.helpers.science import adapt, compressor, describe, features, function


class Case:
    """A plant h = W*' phi + epsilon, |W*^(i)| <= Wbar_i, |phi| in [1, sigma], |epsilon| <= bound."""

    def __init__(self, seed: int, features: int, d: int, gamma: float, noise: float):
        rng = self.rng = np.random.default_rng(seed)
        self.gamma, self.noise = gamma, noise
        self.bounds = rng.uniform(0.1, 2.0, d)
        self.ideal = project_columns(rng.normal(size=(features, d)) * 3, self.bounds)
        self.K = project_columns(rng.normal(size=(features, d)) * 3, self.bounds)
        self.sigma_squared = float(features)

    def phi(self) -> np.ndarray:
        return np.concatenate([[1.0], np.tanh(self.rng.normal(size=len(self.K) - 1) * 2)])

    def step(self) -> tuple[float, float, float, float]:
        """Return (V_t, V_{t+1}, |xtilde|^2, |epsilon|^2) of one step of the law."""
        phi = self.phi()
        epsilon = self.rng.normal(size=self.K.shape[1])
        epsilon *= self.noise * self.rng.uniform() / np.linalg.norm(epsilon)
        error = self.K.T @ phi - (self.ideal.T @ phi + epsilon)
        before = self.lyapunov()
        self.K = adapt(self.K, phi, error, self.gamma, self.bounds)
        return before, self.lyapunov(), float(error @ error), float(epsilon @ epsilon)

    def lyapunov(self) -> float:
        return float(((self.K - self.ideal) ** 2).sum()) / self.gamma


CASES = st.builds(
    Case,
    seed=st.integers(0, 2**32),
    features=st.integers(1, 20),
    d=st.integers(1, 5),
    gamma=st.floats(0.01, 0.99),
    noise=st.sampled_from([0.0, 0.01, 1.0, 30.0]),
)


@settings(max_examples=150, deadline=None)
@given(CASES)
def test_lemma_1_i_ii_iii(case: Case) -> None:
    w_bar = float((case.bounds**2).sum())
    start = case.lyapunov()
    errors = noises = 0.0
    for _ in range(40):
        before, after, error, epsilon = case.step()
        assert after <= 4 / case.gamma * w_bar * (1 + 1e-12)  # (i)
        drift = -(1 - case.gamma) / case.sigma_squared * error + epsilon
        assert after - before <= drift + 1e-9 * (1 + before)  # (ii)
        errors, noises = errors + error, noises + epsilon
    c0 = case.sigma_squared / (1 - case.gamma)
    assert errors <= c0 * noises + c0 * start + 1e-6  # (iii), summed
    assert errors <= c0 * 40 * case.noise**2 + 4 * c0 / case.gamma * w_bar + 1e-6  # (iii), as printed


@settings(max_examples=50, deadline=None)
@given(CASES)
def test_columns_stay_within_their_bounds(case: Case) -> None:
    for _ in range(20):
        case.step()
        assert (np.linalg.norm(case.K, axis=0) <= case.bounds * (1 + 1e-12)).all()


def test_without_noise_the_error_on_a_repeated_point_shrinks_by_one_minus_gamma() -> None:
    phi = np.array([1.0, 0.5, -0.3])
    ideal, K = np.array([[0.1], [0.2], [0.3]]), np.zeros((3, 1))
    for _ in range(3):
        error = K.T @ phi - ideal.T @ phi
        K = adapt(K, phi, error, 0.4, np.array([10.0]))
        np.testing.assert_allclose(K.T @ phi - ideal.T @ phi, 0.6 * error)


def test_projection_scales_a_long_column_and_leaves_a_short_one() -> None:
    K = project_columns(np.array([[3.0, 0.1], [4.0, 0.0]]), np.array([1.0, 1.0]))
    np.testing.assert_allclose(K, [[0.6, 0.1], [0.8, 0.0]])


def test_exact_labels_take_exactly_the_papers_step_and_labels_within_noise_none() -> None:
    oracle, rng = DnnOracle(describe(compressor(), [8]), gamma=0.6), np.random.default_rng(3)
    state, x, u = oracle.initial_state(rng), np.full(4, 0.1), np.array([0.2])
    for _ in range(5):
        h = 0.01 * rng.normal(size=4)
        exact = oracle.learn(state, x, u, h)["K"]
        assert exact.tobytes() == oracle.learn(state, x, u, h, np.zeros(4))["K"].tobytes()
        phi = features(oracle, state, x, u)
        error = (oracle.estimate(state, x, u) - h) / oracle.output_scale
        np.testing.assert_allclose(exact, adapt(state["K"], phi, error, 0.6, oracle.bounds), atol=1e-15)
        wide = oracle.learn(state, x, u, h, (oracle.output_scale * error / 2.9) ** 2)["K"]
        np.testing.assert_array_equal(wide, state["K"])
        state = {**state, "K": exact}


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32),
    gamma=st.floats(0.05, 0.95),
    deviation=st.sampled_from([1e-4, 1e-3, 1e-2, 0.1]),
    within=st.booleans(),
)
def test_lemma_1_with_noisy_labels(seed: int, gamma: float, deviation: float, within: bool) -> None:
    """The oracle itself is tested; `within`: no error of a label exceeds three standard deviations."""
    oracle = DnnOracle(describe(compressor(), [6], scale=0.02), gamma=gamma, column_bound=0.03)
    rng = np.random.default_rng(seed)
    state = oracle.initial_state(rng)
    state["K"] = project_columns(rng.normal(size=state["K"].shape), oracle.bounds)
    ideal = project_columns(rng.normal(size=state["K"].shape), oracle.bounds)
    start, corrected = ((state["K"] - ideal) ** 2).sum(), 0.0
    for _ in range(40):
        x, u = rng.uniform(-0.5, 0.5, 4), rng.uniform(-1, 1, 1)
        phi = features(oracle, state, x, u)
        deviations = deviation * rng.uniform(0.2, 1.0, 4)
        draw = rng.uniform(-3.0, 3.0, 4) if within else 5.0 * rng.normal(size=4)
        epsilon = draw * deviations / oracle.output_scale
        label = ideal.T @ phi + epsilon
        error = state["K"].T @ phi - label
        variance = (deviations / oracle.output_scale) ** 2
        step = gamma * np.maximum(0.0, 1.0 - 9.0 * variance / error**2)
        after = oracle.learn(state, x, u, label * oracle.output_scale, deviations**2)
        np.testing.assert_allclose(after["K"], adapt(state["K"], phi, error, step, oracle.bounds), atol=1e-12)
        before, now = ((state["K"] - ideal) ** 2).sum(), ((after["K"] - ideal) ** 2).sum()
        assert now <= 4.0 * (oracle.bounds**2).sum() * (1 + 1e-12)  # (i)
        bound = (step * (epsilon**2 - (1.0 - step) * error**2)).sum() / (phi @ phi)
        assert now - before <= bound + 1e-10 * (1.0 + before)  # (ii)
        gone = ((step * error) ** 2).sum() / (phi @ phi)
        if within:
            assert now - before <= -(1.0 - gamma) / gamma * gone + 1e-10 * (1.0 + before)  # (iii)
        corrected, state = corrected + gone, after
    if within:
        assert corrected <= gamma / (1.0 - gamma) * start + 1e-8


FILTER = Kalman(prior_variance=0.02, label_variance=1e-3, kept=0.975)


def test_the_weight_follows_the_evidence_of_noisy_labels() -> None:
    rng = np.random.default_rng(0)
    evidence = Evidence(FILTER, np.full(4, 0.05), np.full(4, 0.1))
    state = evidence.nothing()
    np.testing.assert_array_equal(weights(state), 0.0)
    variance = np.array([1e-4, 1e-4, 1e-12, 1e-4])
    found, constants = [], []
    for _ in range(400):
        h_hat = 0.02 * rng.normal(size=4)
        # A correct prediction, one that is independent of h, a correct one of exact labels, and one with a constant
        # error.
        h = np.array([h_hat[0], 0.0, h_hat[2], 0.005]) + np.sqrt(variance) * rng.normal(size=4)
        state |= evidence.with_label(state, h, h_hat, variance)
        found.append(weights(state))
        constants.append(state["constant"][0])
    (good, bad, exact, other), constant = np.mean(found[-200:], axis=0)
    assert good > 0.75
    assert bad < 0.1
    assert abs(exact - 1.0) < 1e-3
    assert other < 0.1
    assert (constant[:3] < 0.2).all()
    assert constant[3] > 0.4
    assert abs(np.mean(constants[-200:], axis=0)[3] - 0.005) < 0.001
    state |= evidence.with_label(state, np.full(4, 1e6), np.zeros(4), variance)
    np.testing.assert_allclose(state["constant"][0], 0.1)


def test_with_exact_labels_the_constant_is_the_remainder_at_once() -> None:
    evidence = Evidence(FILTER, np.full(2, 0.05), np.full(2, 0.1))
    state = evidence.nothing()
    for _ in range(3):
        state |= evidence.with_label(state, np.array([0.03, -0.02]), np.zeros(2), 1e-14)
    np.testing.assert_allclose(weights(state), [[0.0, 0.0], [1.0, 1.0]], atol=0.02)
    np.testing.assert_allclose(state["constant"][0], [0.03, -0.02], rtol=0.01)


def test_the_constant_excludes_the_networks_prediction() -> None:
    evidence = Evidence(FILTER, np.full(2, 0.05), np.full(2, 0.1))
    state, h = evidence.nothing(), np.array([0.03, -0.02])
    for _ in range(100):
        state |= evidence.with_label(state, h, h, 1e-6)
    network, constant = weights(state)
    np.testing.assert_allclose(network * h + constant * state["constant"][0], h, rtol=0.05)


def test_prediction_uses_the_weight_and_training_the_full_K() -> None:
    oracle = DnnOracle(describe(compressor(), [8]), evidence=FILTER)
    plain = DnnOracle(describe(compressor(), [8]))
    state = oracle.initial_state(np.random.default_rng(1))
    x, u = np.full(4, 0.1), np.array([0.2])
    assert not oracle.estimate(state, x, u).any()
    for _ in range(10):
        state = oracle.learn(state, x, u, np.array([0.01, -0.01, 0.0, 1e-4]), np.full(4, 1e-8))
    network, constant = oracle.weights(state)
    assert 0.5 < network[0] <= 1.0
    expected = network * plain.estimate(state, x, u) + constant * state["constant"][0]
    np.testing.assert_allclose(oracle.estimate(state, x, u), expected, rtol=1e-12)
    value = function(oracle)(x, u, oracle.theta(state))[0]
    np.testing.assert_allclose(np.array(value)[:, 0], oracle.estimate(state, x, u), rtol=1e-9, atol=1e-15)
    np.testing.assert_array_equal(oracle.network(state).K, state["K"])
    assert plain.weights(state).shape == (0, 4)
