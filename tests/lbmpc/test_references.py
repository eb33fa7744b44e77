"""References in time: values, preview, changes, saving and restoring."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lbmpc.references import FOR_EVER, PREVIEWED, Change, Reference, between, changed, preview

PERIOD = 0.5
RAMP = Reference((1,), np.array([0.0, 1.0, 1.0, 3.0]), np.array([[0.0], [1.0], [2.0], [0.0]]))
X, AIM = np.array([5.0, 6.0]), np.array([0.5, 0.25])


def go(times: list[float], values: list[float], **more: int) -> Change:
    return Change("set", (1,), np.array(times), np.array(values)[:, None], **more)


@pytest.mark.parametrize(
    ("t", "r"), [(-1.0, 0.0), (0.0, 0.0), (0.25, 0.25), (1.0, 2.0), (2.0, 1.0), (3.0, 0.0), (9.0, 0.0)]
)
def test_it_is_linear_between_its_points_and_steps_at_equal_times(t: float, r: float) -> None:
    assert RAMP.at(t) == pytest.approx([r])
    assert between(RAMP.times, RAMP.values, np.array([t]))[0] == pytest.approx([r])


def test_a_preview_has_the_knots_within_the_horizon_and_its_ends() -> None:
    seen = preview(RAMP, 0.0, PERIOD, 4)
    np.testing.assert_allclose(seen.positions, [0.0, 2.0, 2.0, 4.0])
    np.testing.assert_allclose(seen.values[:, 0], [0.0, 1.0, 2.0, 1.0])
    # A step at the end of the horizon is not included.
    np.testing.assert_allclose(preview(RAMP, 0.0, PERIOD, 2).values[:, 0], [0.0, 1.0])
    later = preview(replace(RAMP, passed=1), 0.25, PERIOD, 4)
    np.testing.assert_allclose(later.positions, [0.0, 0.5, 0.5, 4.0])
    np.testing.assert_allclose(later.values[:, 0], [0.75, 1.0, 2.0, 0.25])


@pytest.mark.parametrize("passed", [6, 7, 10**9])
def test_a_constant_preview_has_one_point(passed: int) -> None:
    seen = preview(replace(RAMP, passed=passed), 0.0, PERIOD, 4)
    assert (seen.positions.tolist(), seen.values.tolist()) == ([0.0], [[0.0]])
    held = Reference((1,), np.array([0.0, 100.0, 100.0]), np.array([[1.0], [1.0], [3.0]]))
    assert preview(held, 0.0, PERIOD, 4).values.tolist() == [[1.0]]


def test_a_preview_is_limited_to_a_few_knots() -> None:
    times = np.arange(1000) * 1e-3
    seen = preview(Reference((0,), times, np.sin(times)[:, None]), 0.0, PERIOD, 4)
    assert len(seen.positions) == PREVIEWED
    assert (np.diff(seen.positions) >= 0).all()
    assert seen.values[-1] == np.sin(0.999)


def test_a_new_reference_starts_at_the_present_value() -> None:
    present = replace(RAMP, passed=1)
    new = changed(present, go([2.0], [3.0]), PERIOD, X, AIM, (0,))
    assert new is not None
    np.testing.assert_allclose(new.values[:, 0], [0.5, 3.0])
    np.testing.assert_allclose(new.times, [0.0, 2.0])
    # An output without a reference starts at the plan's target.
    new = changed(None, go([2.0], [3.0]), PERIOD, X, AIM, (0,))
    assert new is not None
    np.testing.assert_allclose(new.values[:, 0], [0.25, 3.0])
    at_once = changed(present, go([0.0], [3.0]), PERIOD, X, AIM, (0,))
    assert at_once is not None
    assert at_once.values.tolist() == [[3.0]]


def test_a_repeated_reference_only_renews_the_lease() -> None:
    asked = go([2.0], [3.0], lease=4, source=7)
    first = changed(None, asked, PERIOD, X, AIM, (0,))
    assert first is not None
    later = first.advanced(3)
    assert later is not None
    again = changed(later, asked, PERIOD, X, AIM, (0,))
    assert again is not None
    assert (again.passed, again.left) == (3, 4)
    np.testing.assert_array_equal(again.values, first.values)
    for other in (replace(asked, source=8), go([2.0], [3.5], source=7), go([0.0], [3.0], source=7)):
        another = changed(later, other, PERIOD, X, AIM, (0,))
        assert another is not None
        assert another.passed == 0


def test_hold_keeps_the_state_of_the_first_request() -> None:
    hold = Change("hold", lease=2, source=7)
    held = changed(RAMP, hold, PERIOD, X, AIM, (0,))
    assert held is not None
    assert (held.outputs, held.values.tolist(), held.left) == ((0,), [[5.0]], 2)
    again = changed(held.advanced(1), hold, PERIOD, X + 1.0, AIM, (0,))
    assert again is not None
    assert (again.values.tolist(), again.left) == ([[5.0]], 2)
    other = changed(held, replace(hold, source=8), PERIOD, X + 1.0, AIM, (0,))
    assert other is not None
    assert other.values.tolist() == [[6.0]]
    assert changed(held, Change("configured"), PERIOD, X, AIM, (0,)) is None


def test_a_lease_ends_after_its_periods_and_no_lease_never_ends() -> None:
    leased = replace(RAMP, left=3)
    assert leased.advanced(2) is not None
    assert leased.advanced(3) is None
    for_ever = RAMP.advanced(2**70)
    assert for_ever is not None
    assert for_ever.left == FOR_EVER
    assert for_ever.to_arrays()["count"][0] > 2**50


def test_a_reference_is_saved_and_restored() -> None:
    before = replace(RAMP, passed=3, left=9, held=True, source=2**55)
    after = Reference.from_arrays({name: array.copy() for name, array in before.to_arrays().items()}, 2)
    for name, array in before.to_arrays().items():
        np.testing.assert_array_equal(after.to_arrays()[name], array)


@pytest.mark.parametrize(
    ("name", "array"),
    [
        ("outputs", np.array([2])),
        ("outputs", np.array([-1])),
        ("outputs", np.array([0.0])),
        ("outputs", np.array([0, 0])),
        ("times", np.array([0.0, 1.0, 0.5, 3.0])),
        ("times", np.array([0.0, 1.0, 2.0, np.inf])),
        ("times", np.zeros(0)),
        ("times", np.zeros((4, 1))),
        ("values", np.zeros((3, 1))),
        ("values", np.zeros((4, 2))),
        ("values", np.full((4, 1), np.nan)),
        ("count", np.array([-1, 0, 0, 0])),
        ("count", np.array([0, -2, 0, 0])),
        ("count", np.zeros(4)),
        ("more", np.zeros(1)),
    ],
)
def test_invalid_arrays_of_a_reference_are_refused_by_name(name: str, array: np.ndarray) -> None:
    with pytest.raises(ValueError, match=name):
        Reference.from_arrays(RAMP.to_arrays() | {name: array}, 2)
    if name != "more":
        without = {key: value for key, value in RAMP.to_arrays().items() if key != name}
        with pytest.raises(ValueError, match=name):
            Reference.from_arrays(without, 2)
