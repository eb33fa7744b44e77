"""Distrusted sensors: which ones are reported, how soon, the effect on the estimate, and false alarms."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from lbmpc.estimator.base import Estimator, EstimatorState, Measured
from lbmpc.estimator.kalman import KalmanEstimator
from lbmpc.estimator.supervision import SupervisedEstimator
from tests.helpers.science import compressor

MODEL = compressor()
SCALE, PERIOD = MODEL.plant.x_scale, MODEL.period
NOISE, PROCESS = 0.01 * SCALE, MODEL.plant.W * MODEL.period
START = np.array([0.4, -0.3, 0.1, 0.0]) * SCALE
Z, Y = 0, 1
SECOND = round(1.0 / PERIOD)

Sense = Callable[[int, np.ndarray], np.ndarray]
"""Maps a sample's number and the true measurement, (d,), to the displayed one."""


def supervised(noise: np.ndarray = NOISE, measured: tuple[int, ...] = (0, 1, 2, 3)) -> SupervisedEstimator:
    indices = np.array(measured)
    return SupervisedEstimator(KalmanEstimator(MODEL, indices, noise, PROCESS, 1.0), MODEL, indices)


class Ran:
    """The linear model, controlled by its estimate, with a disturbance h(k), and the reported faults."""

    def __init__(
        self,
        sense: Sense,
        steps: int,
        seed: int = 0,
        noise: np.ndarray = NOISE,
        one: Estimator | None = None,
        h: Callable[[int], np.ndarray] = lambda k: np.zeros(4),
        start: np.ndarray = START,
    ):
        one = supervised() if one is None else one
        rng, x, u, memory = np.random.default_rng(seed), start, None, one.initial_state()
        self.faults: list[dict[str, str]] = []
        self.errors, self.x, self.memory = [], [], memory
        for k in range(steps):
            y = sense(k, x + noise * rng.standard_normal(4))
            memory, estimate = one.update(memory, Measured(y, 7, k, u, ()))
            self.faults.append(one.faults(memory))
            self.errors.append((estimate.x - x) / SCALE)
            self.x.append(x)
            u = MODEL.K @ estimate.x + 0.3 * np.sin(0.2 * k) * MODEL.plant.u_scale
            memory = one.commanded(memory, u)
            x = MODEL.step(x, u) + h(k)
        self.memory: EstimatorState = memory

    def first(self, name: str) -> int:
        return next(k for k, faults in enumerate(self.faults) if name in faults)

    @property
    def named(self) -> set[str]:
        return {name for faults in self.faults for name in faults}


def stuck(i: int, at: int) -> Sense:
    held: list[float] = []

    def sense(k: int, y: np.ndarray) -> np.ndarray:
        if k < at:
            return y
        held.append(y[i])
        return np.where(np.arange(4) == i, held[0], y)

    return sense


def replaced(i: int, at: int, until: int, value: float) -> Sense:
    def sense(k: int, y: np.ndarray) -> np.ndarray:
        return np.where((np.arange(4) == i) & (at <= k < until), value, y)

    return sense


def biased(i: int, at: int, share: float) -> Sense:
    return lambda k, y: y + (share * SCALE * (np.arange(4) == i) if k >= at else 0.0)


def good(_k: int, y: np.ndarray) -> np.ndarray:
    return y


@pytest.mark.parametrize("i", [Z, Y])
def test_a_stuck_sensor_is_reported_and_ignored(i: int) -> None:
    ran, name = Ran(stuck(i, 20), 100), MODEL.plant.states[i]
    moved = np.abs(np.array(ran.x)[20:, i] - ran.x[20][i]) > 3.0 * NOISE[i]
    assert ran.first(name) <= 20 + int(np.argmax(moved)) + SECOND
    assert ran.named == {name}
    assert ran.faults[-1][name] == "stuck; what it measures is estimated from the others"
    # The state moves by half of its range meanwhile.
    assert np.abs(np.array(ran.errors)[:, i]).max() < 0.1


def test_a_stuck_only_sensor_is_reported() -> None:
    ran = Ran(stuck(Z, 40), 100, one=supervised(measured=(Z,)))
    assert 40 < ran.first("z") <= 40 + SECOND
    assert np.abs(np.array(ran.errors)[:, Z]).max() < 0.1


def test_a_constant_reading_of_zero_is_reported_and_never_trusted() -> None:
    ran = Ran(replaced(Y, 30, 1000, -MODEL.plant.x_e[Y]), 70)
    assert ran.named == {"y"}
    assert ran.first("y") <= 30 + SECOND
    assert np.abs(np.array(ran.errors)[5:]).max() < 0.08


def test_a_dead_sensor_is_reported_and_trusted_a_second_after_it_recovers() -> None:
    ran = Ran(replaced(Y, 20, 50, np.nan), 90)
    assert ran.named == {"y"}
    assert ran.first("y") == 22
    assert ran.faults[22]["y"].startswith("dead; ")
    again = next(k for k in range(50, 90) if not ran.faults[k])
    assert 50 + SECOND - 1 <= again <= 50 + 2 * SECOND
    assert all(np.isfinite(array).all() for array in ran.memory.values())
    assert np.isfinite(ran.errors).all()


def test_a_short_gap_is_not_a_fault() -> None:
    assert not Ran(replaced(Y, 20, 22, np.nan), 40).named


def test_a_sudden_bias_is_reported_and_ignored() -> None:
    ran = Ran(biased(Y, 40, 0.3), 120)
    assert ran.named == {"y"}
    assert ran.first("y") <= 40 + SECOND
    assert np.abs(np.array(ran.errors)[5:]).max() < 0.1


def test_a_sudden_disturbance_is_not_a_fault() -> None:
    push = 0.1 * SCALE * np.array([0.0, 1.0, 0.0, 0.0])

    def h(k: int) -> np.ndarray:
        return push if k >= 40 else np.zeros(4)

    ran = Ran(good, 120, h=h)
    assert not ran.named
    # The estimate equals that of the filter without supervision.
    alone = Ran(good, 120, h=h, one=KalmanEstimator(MODEL, np.arange(4), NOISE, PROCESS, 1.0))
    np.testing.assert_allclose(np.array(ran.errors)[60:], np.array(alone.errors)[60:], atol=0.02)


def test_a_push_that_shows_in_several_sensors_is_trusted() -> None:
    push = 0.3 * SCALE * np.array([1.0, 1.0, 0.0, 0.0])
    assert not Ran(good, 80, h=lambda k: push if k == 40 else np.zeros(4)).named


def test_a_few_samples_tell_whether_a_sensor_is_quantised() -> None:
    step = 0.01 * SCALE
    rough = Ran(lambda k, y: np.rint(y / step) * step, 12, noise=3.0 * NOISE).memory
    np.testing.assert_allclose(rough["step"], step, rtol=1e-9)
    assert (Ran(good, 12).memory["step"] < 0.25 * NOISE).all()


@pytest.mark.parametrize("told", [0.1, 1.0])
def test_noise_is_not_a_fault_even_if_larger_than_configured(told: float) -> None:
    for seed in range(3):
        assert not Ran(good, 200, seed, one=supervised(told * NOISE)).named


@pytest.mark.parametrize("noise", [0.0, 0.3, 1.0])
def test_a_quantised_sensor_that_repeats_at_rest_is_not_a_fault(noise: float) -> None:
    step = 0.01 * SCALE
    h = 3.0 * PROCESS

    def coarse(_k: int, y: np.ndarray) -> np.ndarray:
        return np.rint(y / step) * step

    ran = Ran(coarse, 300, noise=noise * NOISE, h=lambda k: h)
    assert not ran.named
    assert np.abs(np.array(ran.errors)[40:]).max() < 0.08


def test_a_stuck_quantised_sensor_is_reported() -> None:
    step, hold = 0.01 * SCALE, stuck(Y, 20)
    ran = Ran(lambda k, y: hold(k, np.rint(y / step) * step), 100, noise=0.0 * NOISE)
    assert ran.named == {"y"}


def test_sensors_at_exact_rest_are_not_faulty() -> None:
    one, memory = supervised(), supervised().initial_state()
    for k in range(100):
        memory, _estimate = one.update(memory, Measured(np.zeros(4), 7, k, np.zeros(1) if k else None, ()))
        assert not one.faults(memory)


def test_repeated_readings_of_a_held_plant_are_used() -> None:
    one, memory = supervised(), Ran(good, 40).memory
    for k in range(20):
        # Only z has noise here.
        y = START + np.where(np.arange(4) == Z, 0.001 * k * SCALE, 0.0)
        memory, estimate = one.update(memory, Measured(y, 7, 40 + k, None, ()))
        np.testing.assert_allclose(estimate.x, y)
    assert not one.faults(memory)


def test_states_that_become_unobservable_are_reported() -> None:
    one = supervised(measured=(Z, Y, 2, 3))
    assert one._unseen((Z, Y)) == "what it measures is estimated from the others"
    assert one._unseen(()) == "nothing is measured any more"
    rising = Ran(replaced(2, 20, 1000, np.nan), 40, one=supervised(measured=(2,)))
    assert rising.named == set() or "nothing is measured any more" in rising.faults[-1]["r"]


def test_a_sample_with_some_numbers_is_used() -> None:
    one = supervised(measured=(Z, Y))
    nan = np.nan
    assert one.tells(np.array([0.0, nan, nan, nan]))
    assert not one.tells(np.array([nan, nan, 1.0, 1.0]))
