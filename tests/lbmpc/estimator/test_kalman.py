"""The Kalman estimator: noise, unmeasured states and missing samples."""

from __future__ import annotations

import numpy as np
import pytest

from controller_node.build import build_estimator, build_plant
from lbmpc.estimator.base import Estimate, EstimatorState, Measured
from lbmpc.estimator.kalman import KalmanEstimator, unobservable
from lbmpc.model import Model, build_model
from lbmpc.plants import Known
from node_runtime.config.loading import load
from node_runtime.config.strict import ConfigError
from tests.helpers.plants.unstable import unstable
from tests.helpers.science import compressor

MODEL = compressor()
SCALE = MODEL.plant.x_scale
ALL = np.arange(4)
NOISE = 0.01 * SCALE
PROCESS = MODEL.plant.W * MODEL.period


def estimator(measured: np.ndarray = ALL, noise: np.ndarray = NOISE) -> KalmanEstimator:
    return KalmanEstimator(MODEL, measured, noise, PROCESS, 1.0)


class Motion:
    """The linear model under feedback and a disturbance h, and its samples."""

    def __init__(self, seed: int, x: np.ndarray, h: np.ndarray):
        self.rng, self.x, self.h = np.random.default_rng(seed), x, h
        self.u, self.number = np.zeros(1), 0

    def sample(self, first: bool = False) -> Measured:
        y = self.x + NOISE * self.rng.standard_normal(4)
        return Measured(y, 7, self.number, None if first else self.u, ())

    def go(self) -> None:
        self.u = MODEL.K @ self.x
        self.x = MODEL.step(self.x, self.u) + self.h
        self.number += 1


def followed(
    kalman: KalmanEstimator, motion: Motion, steps: int
) -> tuple[EstimatorState, list[Estimate], np.ndarray, np.ndarray]:
    """Return the final memory, the estimates, and the errors of x (steps, d) and of labels (steps, d)."""
    memory, estimate = kalman.update(kalman.initial_state(), motion.sample(first=True))
    estimates, errors, wrong = [], [], []
    for _ in range(steps):
        before = estimate.x
        motion.go()
        memory, estimate = kalman.update(memory, motion.sample())
        estimates.append(estimate)
        errors.append(estimate.x - motion.x)
        wrong.append(MODEL.label(before, motion.u, estimate.reached) - motion.h)
    return memory, estimates, np.array(errors), np.array(wrong)


H = 0.5 * PROCESS


def test_estimates_beat_samples_and_have_no_bias_under_a_disturbance() -> None:
    memory, _, errors, _ = followed(estimator(), Motion(0, 0.1 * SCALE, H), 800)
    late = errors[200:]
    assert (late.std(axis=0) < 0.75 * NOISE).all()
    assert (np.abs(late.mean(axis=0)) < 0.2 * NOISE).all()
    assert memory["covariance"].shape == (8, 8)
    np.testing.assert_array_equal(memory["covariance"], memory["covariance"].T)


def test_labels_are_unbiased_with_the_stated_variance() -> None:
    _, estimates, _, wrong = followed(estimator(), Motion(1, 0.1 * SCALE, H), 3000)
    late = wrong[200:]
    variance = estimates[-1].variance
    np.testing.assert_allclose(late.var(axis=0), variance, rtol=0.15)
    assert (np.abs(late.mean(axis=0)) < 0.1 * np.sqrt(variance)).all()
    neighbours = (late[1:] * late[:-1]).mean(axis=0) / late.var(axis=0)
    # The correlation is not positive: the error of one label is not repeated by the next.
    assert ((neighbours > -0.25) & (neighbours < 0.1)).all()


def test_unmeasured_states_converge_from_a_wrong_start() -> None:
    kalman = estimator(np.array([0, 1]))
    x = np.array([0.1, -0.1, 0.3, 5.0])
    _, estimates, errors, _ = followed(kalman, Motion(2, x, np.zeros(4)), 100)
    assert abs(errors[0, 3]) > 0.5
    assert (np.abs(errors[-20:]) < 0.1 * SCALE).all()
    # An unmeasured state has a label with a finite, large variance.
    assert all(np.isfinite(estimate.variance).all() for estimate in estimates)


def test_without_noise_the_estimate_is_the_sample() -> None:
    kalman = estimator(noise=np.zeros(4))
    motion = Motion(3, 0.1 * SCALE, H)
    memory, _ = kalman.update(kalman.initial_state(), Measured(motion.x, 7, 0, None, ()))
    for _ in range(20):
        before = motion.x
        motion.go()
        memory, estimate = kalman.update(memory, Measured(motion.x, 7, motion.number, motion.u, ()))
        np.testing.assert_allclose(estimate.x / SCALE, motion.x / SCALE, atol=1e-6)
        np.testing.assert_allclose(MODEL.label(before, motion.u, estimate.reached), H, atol=1e-6)


def test_a_missing_sample_is_predicted_under_the_command() -> None:
    kalman, motion = estimator(), Motion(4, 0.1 * SCALE, H)
    memory, _, _, _ = followed(kalman, motion, 300)
    spread = np.diag(memory["covariance"]).copy()
    for _ in range(3):
        memory = kalman.commanded(memory, MODEL.K @ motion.x)
        motion.go()
        memory = kalman.missed(memory, 0.0)
    assert (np.abs(memory["x"] - motion.x) < 6 * NOISE).all()
    assert (np.diag(memory["covariance"])[:2] > spread[:2]).all()
    # The next sample follows on, without a reset.
    motion.go()
    memory, estimate = kalman.update(memory, motion.sample())
    assert memory["sample"].tolist() == [7, motion.number]
    assert (np.abs(estimate.x - motion.x) < 6 * NOISE).all()


def test_no_prediction_before_the_first_sample() -> None:
    kalman = estimator()
    begin = kalman.initial_state()
    assert kalman.missed(begin, 0.01) is begin


def test_a_missing_sample_after_the_largest_number_is_handled() -> None:
    kalman = estimator()
    memory, _ = kalman.update(kalman.initial_state(), Measured(np.zeros(4), 7, 2**63 - 1, None, ()))
    assert kalman.missed(memory, 0.0)["sample"].tolist() == [7, 2**63 - 1]


def test_the_period_of_a_missing_sample_is_split_where_the_command_took_over() -> None:
    kalman, motion = estimator(), Motion(5, np.zeros(4), np.zeros(4))
    memory, _ = kalman.update(kalman.initial_state(), motion.sample(first=True))
    memory = kalman.commanded(kalman.commanded(memory, np.array([0.2])), np.array([-0.4]))
    delayed = kalman.missed(memory, 0.02)["x"]
    answer = MODEL.within.answer(((0.02, np.array([0.2])), (MODEL.period - 0.02, np.array([-0.4]))))
    np.testing.assert_allclose(delayed, MODEL.A @ memory["x"] + answer, atol=1e-15)


@pytest.mark.parametrize("gap", [2, 5])
def test_the_variance_grows_over_a_gap(gap: int) -> None:
    kalman, motion = estimator(np.array([0, 1])), Motion(6, 0.1 * SCALE, np.zeros(4))
    memory, _, _, _ = followed(kalman, motion, 100)
    before = np.diag(memory["covariance"]).copy()
    for _ in range(gap):
        motion.go()
    memory, _ = kalman.update(memory, motion.sample())
    assert np.diag(memory["covariance"])[3] > 2 * before[3]


def test_another_source_or_a_jump_resets_the_filter() -> None:
    kalman, motion = estimator(), Motion(7, 0.1 * SCALE, H)
    memory, _, _, _ = followed(kalman, motion, 100)
    elsewhere = np.full(4, 0.3)
    for seen in (
        Measured(elsewhere, 8, motion.number + 1, np.zeros(1), ()),
        Measured(elsewhere, 7, motion.number + 1, None, ()),
    ):
        after, estimate = kalman.update(memory, seen)
        np.testing.assert_allclose(estimate.x, elsewhere)
        assert not after["disturbance"].any()


def test_a_late_sample_of_a_period_counted_as_missed_is_used() -> None:
    kalman, motion = estimator(), Motion(8, 0.1 * SCALE, H)
    memory, _, _, _ = followed(kalman, motion, 100)
    memory = kalman.commanded(memory, MODEL.K @ motion.x)
    motion.go()
    missed = kalman.missed(memory, 0.0)
    after, _ = kalman.update(missed, motion.sample())
    assert np.trace(after["covariance"]) < np.trace(missed["covariance"])
    assert after["sample"].tolist() == [7, motion.number]


@pytest.mark.parametrize("gap", [60, 3000])
@pytest.mark.parametrize("counted", [True, False])
def test_an_unstable_plant_is_lost_after_a_long_gap(gap: int, counted: bool) -> None:
    """Another controller holds the plant meanwhile, and the prediction would grow without limit."""
    model = build_model(unstable(20.0), 0.05)
    kalman = KalmanEstimator(model, np.arange(1), np.array([0.01]), np.array([0.01]), 1.0)
    u = np.array([-0.3])
    memory, _ = kalman.update(kalman.initial_state(), Measured(np.array([0.3]), 7, 0, None, ()))
    for _ in range(gap if counted else 0):
        memory = kalman.missed(kalman.commanded(memory, u), 0.0)
        assert all(np.isfinite(array).all() for array in memory.values())
    memory, estimate = kalman.update(memory, Measured(np.array([0.3]), 7, gap + 1, u, ()))
    np.testing.assert_allclose(estimate.x, 0.3)
    assert memory["sample"].tolist() == [7, gap + 1]
    # After that the filter works as usual.
    _, estimate = kalman.update(memory, Measured(np.array([0.3]), 7, gap + 2, u, ()))
    np.testing.assert_allclose(estimate.x, 0.3)
    assert np.isfinite(estimate.variance).all()


def test_a_distrusted_measurement_is_ignored_but_has_an_innovation() -> None:
    kalman, motion = estimator(), Motion(9, 0.1 * SCALE, H)
    memory, _, _, _ = followed(kalman, motion, 100)
    trusted = np.array([True, False, True, True])
    motion.go()
    seen = motion.sample()
    faulty = seen._replace(y=seen.y + np.array([0.0, 0.4, 0.0, 0.0]))
    after, estimate = kalman.update(memory, faulty, trusted)
    without, _ = estimator(np.array([0, 2, 3])).update(memory, seen)
    for name in after:
        np.testing.assert_array_equal(after[name], without[name])
    assert estimate.innovation[1] > 8 * np.sqrt(estimate.innovation_variance[1])
    assert np.abs(estimate.innovation[0]) < 5 * np.sqrt(estimate.innovation_variance[0])
    # If no measurement is trusted, the sample counts as missing.
    nothing, _ = kalman.update(memory, faulty, np.zeros(4, dtype=bool))
    missed = kalman.missed(kalman.commanded(kalman.commanded(memory, motion.u), motion.u), 0.0)
    np.testing.assert_allclose(nothing["x"], missed["x"], rtol=1e-12)


def chain() -> Model:
    """A mass with position and velocity, and an independent heater."""
    a = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    b = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    known = Known.from_matrices(
        a,
        b,
        states=("position", "speed", "heat"),
        inputs=("force", "power"),
        x_min=[-1e5, -1, -1],
        x_max=[1e5, 1, 1],
        u_min=[-1, -1],
        u_max=[1, 1],
        W=[0.1, 0.1, 0.1],
    )
    return build_model(known, 0.01)


def test_unobservable_states_are_named_unless_they_decay() -> None:
    model = chain()
    assert unobservable(model, np.array([0])) == []
    assert unobservable(model, np.array([1])) == [0]
    assert unobservable(model, np.array([2])) == [0, 1]
    assert unobservable(model, np.array([0, 1, 2])) == []


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("estimator.measured=[]", "estimator.measured is empty"),
        ('estimator.measured=["yy"]', "estimator.measured: .* has no state 'yy'; did you mean 'y'"),
        ("estimator.noise={zz=0.1}", "estimator.noise: .* has no state 'zz'"),
        ("plant.sensors.bias={zz=0.1}", "plant.sensors.bias: .* has no state 'zz'"),
    ],
)
def test_an_unknown_state_name_is_refused(text: str, error: str) -> None:
    with pytest.raises(ConfigError, match=error):
        build_plant(load(None, [text]))


def test_the_configuration_error_is_readable() -> None:
    config = load(None, ["rate=100", "estimator.kind=kalman", 'estimator.measured=["speed"]'])
    with pytest.raises(ConfigError, match=r"measured = speed: .* do not determine position"):
        build_estimator(config, chain())
    assert build_estimator(load(None, []), chain()) is None
