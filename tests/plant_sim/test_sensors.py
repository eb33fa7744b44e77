"""Imperfect sensors: each fault alone, by state name, with equal numbers for equal seeds."""

from __future__ import annotations

import numpy as np
import pytest

from lbmpc.plants import get_plant
from node_runtime.config.loading import load
from plant_sim.sensors import Sensors
from plant_sim.shield import measurement

PLANT = get_plant("moore_greitzer")
X = np.array([0.513, 1.61, 1.2, 0.7])


def sensors(*settings: str) -> Sensors:
    return Sensors(load(None, [f"plant.sensors.{text}" for text in settings]), PLANT)


def series(one: Sensors, number: int, period: float = 0.05) -> np.ndarray:
    """Return the measurements, (number, d), as shares of the half-widths; lost samples are NaN."""
    found = [one.measure(X, k * period) for k in range(number)]
    return np.array([np.full(4, np.nan) if y is None else (y - X) / PLANT.x_scale for y in found])


def test_without_faults_the_state_itself_is_measured() -> None:
    assert sensors().measure(X, 0.0) is X


def test_white_noise_scales_with_half_widths_and_depends_on_the_seed() -> None:
    seen = series(sensors("noise=0.01"), 3000)
    np.testing.assert_allclose(seen.std(axis=0), 0.01, rtol=0.05)
    assert np.abs((seen[1:] * seen[:-1]).mean(axis=0)).max() < 1e-5
    np.testing.assert_array_equal(seen, series(sensors("noise=0.01"), 3000))
    other = Sensors(load(None, ["plant.sensors.noise=0.01", "seed=1"]), PLANT)
    assert not np.array_equal(seen, series(other, 3000))


def test_only_the_named_states_have_noise() -> None:
    seen = series(sensors("noise={y=0.02}"), 100)
    assert seen[:, 1].std() > 0.01
    assert not seen[:, [0, 2, 3]].any()


def test_coloured_noise_has_the_same_size_and_is_correlated() -> None:
    seen = series(sensors("noise=0.01", "correlation=0.2"), 20000)
    np.testing.assert_allclose(seen.std(axis=0), 0.01, rtol=0.1)
    np.testing.assert_allclose(
        (seen[4:] * seen[:-4]).mean(axis=0) / seen.var(axis=0), np.exp(-1.0), atol=0.06
    )


def test_quantised_readings_are_multiples_of_the_step() -> None:
    y = sensors("quantisation={z=0.1}").measure(X, 0.0)
    assert y is not None
    np.testing.assert_allclose(y, [0.5, *X[1:]])


def test_a_bias_begins_at_its_time_after_the_first_sample() -> None:
    one = sensors("bias={y=-0.02}", "bias_at=0.5")
    found = np.array([one.measure(X, 1000.0 + t) for t in (0.0, 0.45, 0.55)])
    np.testing.assert_allclose((found - X)[:, 1] / PLANT.x_scale[1], [0.0, 0.0, -0.02], atol=1e-12)


def test_a_stuck_sensor_repeats_its_reading() -> None:
    one = sensors("stuck={z=0.1}")
    moving = [one.measure(X + k * 0.01, k * 0.05) for k in range(6)]
    first = [y[0] for y in moving if y is not None]
    np.testing.assert_allclose(first, X[0] + 0.01 * np.array([0, 1, 2, 2, 2, 2]))
    assert moving[5] is not None
    np.testing.assert_allclose(moving[5][1:], X[1:] + 0.05)


@pytest.mark.parametrize("share", [0.05, 0.5])
def test_the_configured_share_of_samples_is_lost(share: float) -> None:
    lost = np.isnan(series(sensors(f"dropouts={share}"), 4000)[:, 0]).mean()
    assert abs(lost - share) < 0.03


def test_a_dead_sensor_gives_no_number_and_none_is_sent() -> None:
    one = sensors("dead={y=0.1}")
    before, after = one.measure(X, 7.0), one.measure(X, 7.25)
    assert before is not None
    assert after is not None
    np.testing.assert_array_equal(before, X)
    np.testing.assert_array_equal(np.isnan(after), [False, True, False, False])
    told = measurement(PLANT, after)
    assert told["missing"] == ["y"]
    assert np.isfinite(told["x"]).all()
    np.testing.assert_array_equal(np.delete(told["x"], 1), np.delete(X, 1))
    assert measurement(PLANT, before) == {"x": X.tolist()}
