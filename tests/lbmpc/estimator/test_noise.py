"""Unknown measurement noise: estimated from innovations under any h, and then used."""

from __future__ import annotations

import numpy as np
import pytest

from controller_node.build import build_estimator
from lbmpc.estimator.base import Estimate, EstimatorState, Measured
from lbmpc.estimator.kalman import GUESS, KalmanEstimator
from lbmpc.estimator.noise import SAMPLES
from lbmpc.model import Model, build_model
from node_runtime.config.loading import load
from tests.helpers.plants.unstable import unstable
from tests.helpers.science import compressor

COMPRESSOR, RUNAWAY = compressor(), build_model(unstable(3.0), 0.05)


def follow(
    model: Model, kalman: KalmanEstimator, noise: np.ndarray, h: np.ndarray, seed: int, missing: int = 0
) -> tuple[EstimatorState, list[Estimate], np.ndarray]:
    """Return the memory after the steps of h, (steps, d), the estimates, and the errors of their labels, (steps, d).

    missing: interval of the samples that are lost.
    """
    rng, d, scale = np.random.default_rng(seed), model.d, model.plant.x_scale
    memory, x, u = kalman.initial_state(), 0.2 * scale * rng.uniform(-1.0, 1.0, d), np.zeros(model.m)
    estimates: list[Estimate] = []
    wrong: list[np.ndarray] = []
    for t in range(len(h)):
        y = x + noise * rng.standard_normal(d)
        if missing and t % missing == missing - 1:
            memory = kalman.missed(memory, 0.0)
        else:
            memory, now = kalman.update(memory, Measured(y, 7, t, u if t else None, ()))
            if estimates and not missing:
                label = model.label(estimates[-1].x, u, now.reached)
                wrong.append(label - h[t - 1])
            estimates.append(now)
        u = model.K @ estimates[-1].x
        memory = kalman.commanded(memory, u)
        x = model.step(x, u) + h[t]
    return memory, estimates, np.array(wrong)


def slow(model: Model, steps: int, times: float) -> np.ndarray:
    """Return h of `times` times W that varies within a time scale, (steps, d)."""
    t = np.arange(steps)[:, None] * model.period / model.time_scale
    return times * model.plant.W * model.period * np.sin(2.0 * t + np.arange(model.d))


def finding(model: Model, measured: np.ndarray) -> KalmanEstimator:
    return KalmanEstimator(model, measured, None, model.plant.W * model.period, model.time_scale)


@pytest.mark.parametrize("level", [0.001, 0.003, 0.02])
@pytest.mark.parametrize(("times", "measured"), [(0.0, [0, 1, 2, 3]), (20.0, [0, 1, 2, 3]), (20.0, [0, 1])])
def test_the_estimate_is_the_noise_and_not_h(level: float, times: float, measured: list[int]) -> None:
    model = COMPRESSOR
    kalman, noise = finding(model, np.array(measured)), level * model.plant.x_scale
    for seed in range(3):
        memory, _, _ = follow(model, kalman, noise, slow(model, SAMPLES + 10, times), seed)
        assert memory["finder.counts"][1] == SAMPLES
        share = (kalman.found_noise(memory) / noise)[measured]
        assert (share > 1 / 1.5).all()
        assert (share < 1.5).all()
        assert not np.delete(kalman.found_noise(memory), measured).any()


def test_the_noise_of_a_fast_unstable_plant_is_found() -> None:
    """Its filter needs a high gain, which mixes earlier noise into every innovation."""
    kalman, noise = finding(RUNAWAY, np.arange(1)), 0.003 * RUNAWAY.plant.x_scale
    memory, _, _ = follow(RUNAWAY, kalman, noise, slow(RUNAWAY, SAMPLES + 10, 1.0), 0)
    np.testing.assert_allclose(kalman.found_noise(memory), noise, rtol=0.4)


def test_one_noisy_sensor_among_quiet_ones_is_identified() -> None:
    noise = np.array([0.02, 0.001, 0.001, 0.005]) * COMPRESSOR.plant.x_scale
    memory, _, _ = follow(COMPRESSOR, finding(COMPRESSOR, np.arange(4)), noise, slow(COMPRESSOR, 110, 1.0), 1)
    share = memory["noise"] / noise
    assert ((share > 1 / 1.5) & (share < 1.5)).all()


def test_labels_use_the_variance_of_the_estimated_noise() -> None:
    model, noise = COMPRESSOR, 0.003 * COMPRESSOR.plant.x_scale
    h = np.tile(0.5 * model.plant.W * model.period, (900, 1))
    memory, estimates, wrong = follow(model, finding(model, np.arange(4)), noise, h, 2)
    share = estimates[-1].variance / wrong[SAMPLES + 50 :].var(axis=0)
    # The ratio is that of the estimated and the true noise, squared.
    found = (memory["noise"] / noise) ** 2
    np.testing.assert_allclose(share, found, rtol=0.25)
    # The initial guess would be ten times too large.
    assert (share < 0.3 * (GUESS / 0.003) ** 2).all()


def test_missing_and_distrusted_samples_add_no_innovations_and_keep_the_rest() -> None:
    kalman, noise = finding(COMPRESSOR, np.arange(4)), 0.003 * COMPRESSOR.plant.x_scale
    memory, _, _ = follow(COMPRESSOR, kalman, noise, slow(COMPRESSOR, 150, 1.0), 3, missing=10)
    gathered = memory["finder.counts"][1]
    # Among nine consecutive innovations the first three have no difference, and the very first sample has none.
    assert gathered == 15 * 6 - 1
    share = memory["noise"] / noise
    assert ((share > 1 / 1.6) & (share < 1.6)).all()
    faulty = Measured(np.full(4, 0.4), 7, 150, np.zeros(1), ())
    after, _ = kalman.update(memory, faulty, np.array([True, True, True, False]))
    assert after["finder.counts"].tolist() == [0, gathered]
    # A restarted plant keeps its sensors.
    again, _ = kalman.update(after, Measured(np.zeros(4), 8, 0, None, ()))
    np.testing.assert_array_equal(again["noise"], memory["noise"])
    assert again["finder.counts"].tolist() == [0, gathered]


def test_the_guess_is_used_at_first_and_configured_noise_never_changes() -> None:
    kalman, scale = finding(COMPRESSOR, np.arange(4)), COMPRESSOR.plant.x_scale
    memory, _, _ = follow(COMPRESSOR, kalman, 0.1 * scale, slow(COMPRESSOR, 15, 1.0), 4)
    np.testing.assert_allclose(kalman.found_noise(memory), GUESS * scale)
    told = KalmanEstimator(COMPRESSOR, np.arange(2), 0.02 * scale, COMPRESSOR.plant.W * 0.05, 1.0)
    memory, _, _ = follow(COMPRESSOR, told, 0.1 * scale, slow(COMPRESSOR, 40, 1.0), 4)
    assert told.found_noise(memory).shape == (0,)
    np.testing.assert_allclose(told.noise(memory), [0.01, 0.01, 0.0, 0.0])
    assert sorted(memory) == ["covariance", "disturbance", "inputs", "sample", "x"]


def test_the_default_correlation_is_the_time_scale_of_the_plant() -> None:
    settings = ["rate=20", "estimator.kind=kalman"]
    seen = Measured(0.1 * RUNAWAY.plant.x_scale, 7, 1, np.zeros(1), ())

    def covariance(model: Model, *more: str) -> np.ndarray:
        kalman = build_estimator(load(None, [*settings, *more]), model)
        assert kalman is not None
        first = Measured(np.zeros(model.d), 7, 0, None, ())
        memory, _ = kalman.update(kalman.initial_state(), first)
        y = np.zeros(model.d)
        return kalman.update(memory, seen._replace(y=y))[0]["covariance"]

    for model in (COMPRESSOR, RUNAWAY):
        scaled = covariance(model, f"estimator.correlation={model.time_scale}")
        np.testing.assert_array_equal(covariance(model), scaled)
    assert COMPRESSOR.time_scale == 1.0
    assert RUNAWAY.time_scale != 1.0
