"""Identification of A, B, c and W from samples: exact where possible, with readable refusals otherwise."""

from __future__ import annotations

import numpy as np
import pytest

from lbmpc.identification import (
    BLOCKS,
    MARGIN,
    NotIdentifiable,
    Quality,
    Transitions,
    Variables,
    identify,
)

PERIOD = 0.5
A = np.array([[0.9, 0.2], [-0.1, 0.8]])
B = np.array([[0.0], [3.0]])
C = np.array([0.02, -40.0])
TWO = Variables(
    ("level", "pressure"),
    ("pump",),
    np.array([2.0, 1e5]),
    np.array([5.0]),
    np.array([1.0, 0.0]),
    np.array([2.0]),
)
# In units of the half-widths, so that a pressure of 1e5 has the dynamics above.
UNITS = TWO.x_scale[:, None] / TWO.x_scale
A_PLANT, B_PLANT = A * UNITS, B * TWO.x_scale[:, None] / TWO.u_scale
RNG = np.random.default_rng


def moved(
    count: int, noise: float = 0.0, feedback: np.ndarray | None = None, push: float = 0.3, seed: int = 0
) -> Transitions:
    """Return motion of the plant above; `feedback`, `push` and `noise` (standard deviations) are in half-widths."""
    rng = RNG(seed)
    x, u = np.zeros((count + 1, 2)), np.zeros((count, 1))
    x[0] = 0.5 * TWO.x_scale
    for k in range(count):
        u[k] = push * TWO.u_scale * rng.standard_normal(1)
        if feedback is not None:
            u[k] += TWO.u_scale * (feedback @ (x[k] / TWO.x_scale))
        x[k + 1] = A_PLANT @ x[k] + B_PLANT @ u[k] + C + noise * TWO.x_scale * rng.standard_normal(2)
    return Transitions(x[:-1] + TWO.x_e, u + TWO.u_e, x[1:] + TWO.x_e)


def refused(samples: Transitions, variables: Variables = TWO) -> str:
    with pytest.raises(NotIdentifiable) as caught:
        identify(samples, PERIOD, variables)
    return str(caught.value)


def test_a_linear_plant_is_found_to_rounding_with_its_offset() -> None:
    found = identify(moved(200), PERIOD, TWO)
    np.testing.assert_allclose(found.A, A_PLANT, rtol=1e-9, atol=1e-12 * UNITS.max())
    np.testing.assert_allclose(found.B, B_PLANT, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found.offset, C, rtol=1e-8)
    assert found.samples == 200
    assert (found.held_out.largest < 1e-10).all()


def test_standard_errors_match_the_scatter_of_many_logs() -> None:
    """With process noise the scatter over 60 logs equals the error stated for each, to a third."""
    logs = [identify(moved(300, noise=0.02, seed=seed), PERIOD, TWO) for seed in range(60)]
    for value, error in (("A", "A_error"), ("B", "B_error"), ("offset", "offset_error")):
        scatter = np.std([getattr(log, value) for log in logs], axis=0)
        said = np.sqrt(np.mean([getattr(log, error) ** 2 for log in logs], axis=0))
        np.testing.assert_allclose(said / scatter, 1.0, atol=0.33)


def test_w_exceeds_every_held_out_residual() -> None:
    samples = moved(400, noise=0.02)
    found = identify(samples, PERIOD, TWO)
    np.testing.assert_array_less(MARGIN * found.held_out.largest * TWO.x_scale * (1 - 1e-12), found.W)
    np.testing.assert_array_less(found.W, 1.11 * MARGIN * found.held_out.largest * TWO.x_scale)
    assert [float(f"{w:.2g}") for w in found.W] == pytest.approx(found.W.tolist(), rel=1e-12)
    # Computed by hand in the plant's units: each block with a fit of the others.
    z = np.column_stack([samples.x, samples.u, np.ones(len(samples))])
    missed = []
    for block in np.array_split(np.arange(len(samples)), BLOCKS):
        rest = np.setdiff1d(np.arange(len(samples)), block)
        theta = np.linalg.lstsq(z[rest] / z.max(axis=0), samples.after[rest], rcond=None)[0]
        missed.append(samples.after[block] - z[block] / z.max(axis=0) @ theta)
    by_hand = Quality.of(np.vstack(missed), TWO.x_scale, PERIOD)
    np.testing.assert_allclose(found.held_out.rms, by_hand.rms, rtol=1e-9)
    np.testing.assert_allclose(found.held_out.largest, by_hand.largest, rtol=1e-9)


def test_blocks_of_time_detect_a_change_of_the_plant() -> None:
    """The plant changes in the middle of the log. Random blocks would hide that."""
    first, later = moved(200), moved(200, seed=1)
    later = Transitions(later.x, later.u, later.after + 0.05 * TWO.x_scale)
    joined = first.then(later)
    order = RNG(0).permutation(len(joined))
    mixed = Transitions(joined.x[order], joined.u[order], joined.after[order])
    slow = identify(joined, PERIOD, TWO).offset_error
    assert (slow > 2.0 * identify(mixed, PERIOD, TWO).offset_error).all()


def test_a_plant_under_feedback_is_identified_with_an_added_signal() -> None:
    found = identify(moved(400, noise=1e-3, feedback=np.array([-0.3, -0.2]), push=0.1), PERIOD, TWO)
    assert (np.abs(found.A - A_PLANT) < 4.0 * found.A_error + 1e-12).all()
    assert (np.abs(found.B - B_PLANT) < 4.0 * found.B_error + 1e-12).all()


def test_a_plant_under_fixed_feedback_is_refused() -> None:
    said = refused(moved(400, noise=0.05, feedback=np.array([-0.3, -0.2]), push=0.0))
    assert "pump = -0.75 level -1e-05 pressure + constant, to" in said
    assert "as under one fixed feedback" in said
    assert "several x0" in said


def test_a_repeated_path_of_a_nonlinear_plant_gives_large_errors() -> None:
    """A cart with drag returns ten times along the same path under one slightly nonlinear feedback."""
    T, gain = 0.05, 0.7
    cart = Variables(("position", "speed"), ("force",), np.ones(2), np.array([3.0]), np.zeros(2), np.zeros(1))
    rng, runs = RNG(0), []
    for _ in range(10):
        x, u = np.zeros((101, 2)), np.zeros((100, 1))
        x[0] = -0.8, 0.0
        for k in range(100):
            u[k] = -0.98 * x[k, 0] - 1.46 * x[k, 1] + 0.4 * x[k, 0] ** 3 + 1e-4 * rng.standard_normal()
            slope = gain * u[k, 0] - 0.4 * x[k, 1] - 0.5 * x[k, 1] * abs(x[k, 1])
            x[k + 1] = x[k] + T * np.array([x[k, 1], slope])
        runs.append(Transitions(x[:-1], u, x[1:]))
    samples = runs[0]
    for later in runs[1:]:
        samples = samples.then(later)
    found = identify(samples, T, cart)
    assert abs(found.B[1, 0] - gain * T) < 2.0 * found.B_error[1, 0]
    # The estimated offset is zero within its error, because the cart does not move at rest.
    assert abs(found.offset[1]) < 3.0 * found.offset_error[1]
    # More samples of the same path do not reduce the error.
    once = identify(runs[0], T, cart)
    assert found.B_error[1, 0] > 0.4 * once.B_error[1, 0]


def test_a_constant_input_is_reported() -> None:
    said = refused(moved(400, noise=0.05, push=0.0))
    assert "pump hardly moves: by 0 % of its half-width (RMS)" in said
    assert "feedback, so" not in said


def test_a_constant_state_is_reported_alone() -> None:
    samples = moved(400)
    level = samples.x * [1, 0]
    said = refused(Transitions(level, samples.u, 0.9 * level))
    assert said.count("\n  - ") == 1
    assert "pressure hardly moves" in said


def test_states_that_move_together_are_reported() -> None:
    rng = RNG(0)
    level = rng.standard_normal(300)
    x = np.column_stack([level, 5e4 * level])
    u = rng.standard_normal((300, 1))
    said = refused(Transitions(x, u, x))
    assert "level = +2e-05 pressure + constant" in said
    assert "they move only together" in said


def test_too_few_samples_are_reported() -> None:
    assert "39 samples are too few: each row of the model has 4 numbers (level, pressure, pump" in refused(
        moved(39)
    )
    assert identify(moved(40), PERIOD, TWO).samples == 40


def test_motion_below_the_measurement_noise_is_refused() -> None:
    true = moved(2000, push=0.005)
    true = Transitions(true.x[200:], true.u[200:], true.after[200:])
    seen = 0.02 * TWO.x_scale * RNG(1).standard_normal((len(true) + 1, 2))
    said = refused(Transitions(true.x + seen[:-1], true.u, true.after + seen[1:]))
    assert "like measurement noise" in said


def test_a_log_whose_parts_disagree_is_refused() -> None:
    """The pressure moves within one block only, so without that block its effect is unknown."""
    rng = RNG(0)
    x, u = rng.standard_normal((500, 2)) * TWO.x_scale, rng.standard_normal((500, 1)) * TWO.u_scale
    x[60:, 1] = 0.0
    after = x @ A_PLANT.T + u @ B_PLANT.T
    after[:30, 1] += 0.3 * x[:30, 1]
    said = refused(Transitions(x, u, after))
    assert "the effect of pressure on" in said
    assert "small compared with the error of a linear model" in said
