"""Lemma 1 of the paper, held on synthetic plants whose ideal weights W* are known."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from lbmpc.oracles.dnn.adaptation_law import project_columns
from tests.helpers.science import adapt


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
        """(V_t, V_{t+1}, |xtilde|^2, |epsilon|^2) of one step of the law."""
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
def test_the_columns_never_leave_their_bounds(case: Case) -> None:
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
