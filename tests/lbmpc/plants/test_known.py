"""A plant given by numbers: defaults, faults, motion within a period, rest, and its JSON form."""

from __future__ import annotations

import json
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest

from examples.quadrotor.quadrotor import QUADROTOR
from examples.tanks.tanks import TANKS
from lbmpc.model import ModelError, build_model
from lbmpc.plants import PLANTS, Known, Plant, PlantDefinitionError, PlantError, Truth, get_plant, true_motion
from lbmpc.plants.inspection import faults
from lbmpc.plants.linear_motion import Continuous, StraightLine, discretise
from lbmpc.plants.moore_greitzer import MOORE_GREITZER
from tests.helpers.plants.integrator import INTEGRATOR
from tests.helpers.plants.pendulum import PENDULUM

INF, NAN = float("inf"), float("nan")
A, B = [[0.0, 1.0], [-2.0, -0.3]], [[0.0], [1.0]]
BOX: dict[str, Any] = {
    **{"W": [0.01, 0.1], "x_min": [-1.0, -2.0], "x_max": [1.0, 2.0]},
    **{"u_min": [-3.0], "u_max": [3.0]},
}


def numbers(a: Any = A, b: Any = B, **changes: Any) -> Known:
    return Known.from_matrices(a, b, **{**BOX, **changes})


def sampled(a: Any = A, b: Any = B, period: float = 0.1, **changes: Any) -> Known:
    """Return a discrete-time plant."""
    A_d, B_d = discretise(np.array(a), np.array(b), period)
    return numbers(A_d, B_d, period=period, **changes)


def test_defaults_are_applied() -> None:
    known = Known.from_matrices(A, B, W=[0.01, 0.1], scale={"x1": 1.0, "x2": 2.0, "u1": 3.0})
    assert (known.states, known.inputs, known.performance) == (("x1", "x2"), ("u1",), (0, 1))
    assert (known.x_e.tolist(), known.u_e.tolist(), known.x0.tolist()) == ([0.0, 0.0], [0.0], [0.0, 0.0])
    assert known.units == {"x1": "1", "x2": "1", "u1": "1", "t": "s"}
    assert faults(known) == ()
    model = build_model(known, 0.1)
    assert model.plant is known
    assert model.equations is None


def test_the_numbers_of_equations_make_the_same_model() -> None:
    known = MOORE_GREITZER.known()
    from_numbers, from_equations = build_model(known, 0.05), build_model(MOORE_GREITZER, 0.05)
    for name in ("A", "B", "K", "P", "Q", "R"):
        np.testing.assert_array_equal(getattr(from_numbers, name), getattr(from_equations, name))
    x, u = np.array([0.1, -0.2, 0.3, 2.0]), np.array([0.4])
    np.testing.assert_array_equal(from_numbers.ahead(x, u, 0.02), from_equations.ahead(x, u, 0.02))
    assert from_equations.equations is MOORE_GREITZER
    with pytest.raises(ModelError, match="the oracle perfect needs the equations of moore_greitzer"):
        from_numbers.require_equations("the oracle perfect")


# -- faults -----------------------------------------------------------------------------------

FAULTY: dict[str, tuple[dict[str, Any], str]] = {
    "A as text": ({"a": "fast"}, "A is 'fast': give a square matrix"),
    "A of rows of different lengths": ({"a": [[0.0, 1.0], [2.0]]}, "A is .*: give a square matrix"),
    "A that is not square": ({"a": [[0.0, 1.0]]}, "A is .*: give a square matrix"),
    "B without columns": ({"b": [0.0, 1.0]}, r"B is \[0.0, 1.0\]: .* for one input, for example, \[\[0.0\]"),
    "B of another plant": (
        {"b": [[0.0]]},
        r"B has the shape \(1, 1\): it needs \(2, 1\), a row for each of x1, x2",
    ),
    "more names than states": (
        {"states": ("a", "b", "c"), "x_min": None, "x_max": None, "W": [1, 1, 1]},
        r"3 states are named \(a, b, c\), but A and B have 2 rows",
    ),
    "names as one text": ({"states": "ab"}, "states is the text 'ab'"),
    "NaN in A": ({"a": [[0.0, 1.0], [NAN, 0.0]]}, "A is nan from x1 to x2: give a finite number"),
    "infinity in B": ({"b": [[0.0], [INF]]}, "B is inf from u1 to x2"),
    "a period of zero": ({"period": 0.0}, "period is 0.0: give the seconds from x to"),
    "a negative period": ({"period": -0.1}, "period is -0.1"),
    "a period as text": ({"period": "fast"}, "period is 'fast'"),
    "a name that is not text": ({"names": {"x1": 3}}, "names is {'x1': 3}: give texts by name"),
    "a unit of an unknown name": ({"units": {"x9": 3}}, "units is .*'x9': 3}: give texts by name"),
    "no W": ({"W": None}, "W is missing: give the half-widths .* x1, x2"),
    "an infinite W": ({"W": [0.1, INF]}, "W of x2 is inf"),
    "no bounds and no scale": (
        {"x_max": [INF, 2.0]},
        r"x_min of x1 is -1 and x_max is inf: give both bounds, or scale=\{'x1'",
    ),
    "a state that no input moves": (
        {"a": [[0.0, 1.0], [0.0, 0.5]], "b": [[1.0], [0.0]]},
        r"no input moves x2, which grows by exp\(0.5 t\) \(eigenvalue 0.5 of A\): A and B cannot be stabilised",
    ),
    "a constant that no input moves": (
        {"a": [[-1.0, 1.0], [0.0, 0.0]], "b": [[1.0], [0.0]]},
        "x2, which does not decay",
    ),
    "a pair that no input moves": (
        {"a": [[0.1, 1.0], [-1.0, 0.1]], "b": [[0.0], [0.0]]},
        r"no input moves the mode of x1, x2, which grows by exp\(0.1 t\) \(eigenvalue 0.1 \+ 1i",
    ),
    "a sampled state that no input moves": (
        {"a": [[0.5, 1.0], [0.0, 1.1]], "b": [[1.0], [0.0]], "period": 0.1},
        r"no input moves .*x2, which grows by exp\(0.953 t\) \(eigenvalue 1.1 of A\)",
    ),
    "an offset of the wrong length": (
        {"offset": [1.0]},
        r"offset is \[1.0\]: it needs 2 finite numbers, .* x1, x2",
    ),
    "an offset that nothing holds": (
        {"a": [[-9.0, 0.0], [0.0, 0.0]], "b": [[1.0], [1.0]], "offset": [0.0, 4.0]},
        "cannot be used at the nearest rest: u_e of u1 is -4, but u_min of u1 is -3",
    ),
}


@pytest.mark.parametrize("case", FAULTY)
def test_a_fault_of_numbers_is_reported(case: str) -> None:
    given, message = FAULTY[case]
    with pytest.raises(PlantDefinitionError, match=message) as caught:
        numbers(**given)
    text = str(caught.value)
    assert text.startswith("the plant 'plant' cannot be used")
    # Each fault gives one sentence.
    assert "\n" not in text


def test_faults_of_numbers_are_reported_for_unchecked_plants(monkeypatch: pytest.MonkeyPatch) -> None:
    bad = replace(numbers(), W=[-1.0, 0.1], A=np.eye(3))
    monkeypatch.setitem(PLANTS, "plant", bad)
    with pytest.raises(PlantDefinitionError, match=r"A has the shape \(3, 3\)"):
        get_plant("plant")
    with pytest.raises(ModelError, match=r"A has the shape \(3, 3\)"):
        build_model(bad, 0.1)


def test_a_mode_that_decays_needs_no_input() -> None:
    assert faults(numbers([[0.5, 0.0], [0.0, -1.0]], [[1.0], [0.0]])) == ()


# -- discrete time ----------------------------------------------------------------------------


def test_a_model_in_discrete_time_is_used_at_its_own_rate_only() -> None:
    known = sampled(period=0.02)
    model = build_model(known, 1 / 50)
    np.testing.assert_array_equal(model.A, known.A)
    with pytest.raises(ModelError, match=r"for a period of 0.02 s, but the rate gives 0.05 s: .*rate = 50"):
        build_model(known, 0.05)


@pytest.mark.parametrize("shares", [(1.0,), (0.3,), (0.3, 0.7), (1.5,), (4.2,)])
def test_a_sampled_model_moves_within_a_period_like_its_source(shares: tuple[float, ...]) -> None:
    continuous, discrete = build_model(numbers(), 0.1), build_model(sampled(), 0.1)
    assert isinstance(discrete.within, Continuous)
    x, there = np.array([0.3, -0.5]), np.array([0.3, -0.5])
    for k, share in enumerate(shares):
        u = np.array([0.7 - k])
        x, there = continuous.ahead(x, u, 0.1 * share), discrete.ahead(there, u, 0.1 * share)
    np.testing.assert_allclose(there, x, atol=1e-12)


def test_a_label_with_pieces_equals_that_of_the_true_motion() -> None:
    known = sampled()
    model, truth = build_model(known, 0.1), true_motion(numbers())
    x, pieces = np.array([0.3, -0.5]), ((0.03, np.array([1.0])), (0.07, np.array([-2.0])))
    after = x
    for seconds, u in pieces:
        after = truth.step(after, u, seconds)
    np.testing.assert_allclose(model.label(x, np.array([-1.1]), after, pieces), np.zeros(2), atol=1e-12)


WITHOUT_MOTION = {
    "a dead time": ([[0.9, 0.5], [0.0, 0.0]], [[0.0], [1.0]]),
    "two dead times": ([[0.9, 0.5, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]], [[0.0], [0.0], [1.0]]),
    "a dead time that was identified": (
        [[0.9, 0.5, 0.0], [0.0, 1e-9, 1.0], [0.0, 1e-9, 1e-9]],
        [[0.0], [0.0], [1.0]],
    ),
    "a motion that consists of rounding": (
        [[0.9, 0.5, 0.0], [0.0, 0.0, 1.0], [0.0, -1e-6, 0.0]],
        [[0.0], [0.0], [1.0]],
    ),
    "a sign that alternates": ([[-0.4, 0.1], [0.0, 0.8]], [[1.0], [1.0]]),
}


@pytest.mark.parametrize("case", WITHOUT_MOTION)
def test_an_unknown_motion_within_a_period_is_a_straight_line(case: str) -> None:
    a, b = WITHOUT_MOTION[case]
    d = len(a)
    known = Known.from_matrices(
        a, b, period=0.1, W=[0.1] * d, x_min=[-1.0] * d, x_max=[1.0] * d, u_min=[-1], u_max=[1]
    )
    model = build_model(known, 0.1)
    assert isinstance(model.within, StraightLine)
    x, u = np.linspace(0.5, -0.4, d), np.array([0.3])
    after = model.step(x, u)
    np.testing.assert_allclose(model.ahead(x, u, 0.0), x)
    np.testing.assert_allclose(model.ahead(x, u, 0.04), 0.6 * x + 0.4 * after)
    np.testing.assert_allclose(model.ahead(x, u, 0.1), after)
    np.testing.assert_allclose(
        model.ahead(x, u, 0.25), 0.5 * (model.step(after, u) + model.step(model.step(after, u), u))
    )
    # The label of a constant input does not depend on its pieces.
    for pieces in ((), ((0.1, u),), ((0.03, u), (0.07, u))):
        np.testing.assert_allclose(model.label(x, u, after, pieces), np.zeros(d), atol=1e-15)


# -- numbers as the truth ---------------------------------------------------------------------


@pytest.mark.parametrize("known", [numbers(), sampled()], ids=["continuous", "discrete"])
def test_numbers_move_by_their_model(known: Known) -> None:
    x_e, u_e = np.array([0.1, 0.2]), np.array([0.5])
    model, truth = build_model(known, 0.1), true_motion(replace(known, x_e=x_e, u_e=u_e))
    x, u = np.array([0.3, -0.5]), np.array([-0.7])
    after = truth.step(x + x_e, u + u_e, 0.1) - x_e
    np.testing.assert_allclose(after, model.step(x, u), atol=1e-13)
    halfway = truth.step(truth.step(x + x_e, u + u_e, 0.06), u + u_e, 0.04) - x_e
    np.testing.assert_allclose(halfway, after, atol=1e-12)


def test_without_a_motion_within_a_period_only_whole_periods_are_simulated() -> None:
    a, b = WITHOUT_MOTION["a dead time"]
    known = numbers(a, b, period=0.1)
    truth, x, u = true_motion(known), np.array([0.3, -0.5]), np.array([-0.7])
    np.testing.assert_allclose(truth.step(x, u, 0.1), known.A @ x + known.B @ u)
    np.testing.assert_allclose(
        truth.step(x, u, 0.3), truth.step(truth.step(truth.step(x, u, 0.1), u, 0.1), u, 0.1)
    )
    with pytest.raises(PlantError, match=r"no motion between two samples.*plant\.truth"):
        truth.step(x, u, 0.04)


# -- rest -------------------------------------------------------------------------------------


def test_an_input_balances_an_offset_if_possible() -> None:
    known = numbers(offset=[0.0, 0.4])
    assert (known.x_e.tolist(), known.u_e.tolist()) == ([0.0, 0.0], [-0.4])
    # Defaults that depend on the equilibrium follow it.
    assert (known.x0.tolist(), known.safe_input.tolist()) == ([0.0, 0.0], [-0.4])
    kept = numbers(offset=[0.0, 0.4], x0=[0.5, 0.0], safe_input=[0.0])
    assert (kept.x0.tolist(), kept.safe_input.tolist()) == ([0.5, 0.0], [0.0])


def test_the_state_moves_if_no_input_balances_an_offset() -> None:
    known = numbers(offset=[0.3, 0.4], x_e=[0.1, 0.0], u_e=[1.0])
    drift = np.array(A) @ (known.x_e - [0.1, 0.0]) + np.array(B) @ (known.u_e - 1.0) + [0.3, 0.4]
    np.testing.assert_allclose(drift, np.zeros(2), atol=1e-14)
    # Only the velocity changes, to -0.3.
    np.testing.assert_allclose(known.x_e, [0.1, -0.3], atol=1e-14)


def test_performance_states_move_last() -> None:
    """An actuator with a delay of one period balances the offset, although the first state could move as well."""
    a, b = [[1.05, 0.1], [0.0, 0.0]], [[0.0], [1.0]]
    held = numbers(a, b, period=0.1, offset=[0.01, 0.0], performance=(0,))
    np.testing.assert_allclose([*held.x_e, *held.u_e], [0.0, -0.1, -0.1], atol=1e-14)
    shared = numbers(a, b, period=0.1, offset=[0.01, 0.0])
    assert np.linalg.norm(shared.x_e / [1.0, 2.0]) < np.linalg.norm(held.x_e / [1.0, 2.0])
    np.testing.assert_allclose(0.05 * shared.x_e[0] + 0.1 * shared.x_e[1], -0.01, atol=1e-14)


def test_in_discrete_time_an_offset_is_that_of_the_next_state() -> None:
    known = sampled(offset=[0.01, 0.02])
    there = known.A @ -known.x_e + known.B @ -known.u_e + known.x_e + [0.01, 0.02]
    # One step from the old origin: x+ - x is the offset.
    np.testing.assert_allclose(
        there + known.A @ known.x_e + known.B @ known.u_e - known.x_e, [0.01, 0.02], atol=1e-14
    )
    np.testing.assert_allclose(
        (known.A - np.eye(2)) @ known.x_e + known.B @ known.u_e, [-0.01, -0.02], atol=1e-14
    )


def test_numbers_can_rest_at_another_point() -> None:
    moved = numbers().resting_near(x_e=[0.5, 0.0])
    np.testing.assert_allclose(moved.x_e, [0.5, 0.0], atol=1e-14)
    np.testing.assert_allclose(moved.u_e, [1.0], atol=1e-14)


@pytest.mark.parametrize("plant", [TANKS, TANKS.known()], ids=["equations", "numbers"])
def test_a_configuration_can_set_the_rest(plant: Plant | Known) -> None:
    lower = 14.0
    upper = plant.resting_near(x_e=[9.0, lower]).x_e[0]
    there = plant.changed({"q": (0.0, 25.0)}, x_e=[upper, lower])
    assert there.u_max.tolist() == [25.0]
    np.testing.assert_allclose(there.x_e, [upper, lower], rtol=1e-9)
    assert faults(there) == ()
    # The displayed values can be configured, and give exactly the same plant.
    again = plant.changed({"q": (0.0, 25.0)}, there.x_e.tolist(), there.u_e.tolist())
    assert (again.x_e.tolist(), again.u_e.tolist()) == (there.x_e.tolist(), there.u_e.tolist())
    with pytest.raises(
        PlantDefinitionError, match=r"no input holds it there: x_e = .* The nearest rest is x_e = \["
    ):
        plant.changed({}, x_e=[upper + 0.5, lower])


def test_numbers_rest_only_where_their_matrices_do() -> None:
    with pytest.raises(
        PlantDefinitionError, match=r"not an equilibrium: x_e = \[0.5, 0.0\], u_e = \[0.9\]. The nearest"
    ):
        numbers().changed({}, [0.5, 0.0], [0.9])


def test_a_plant_is_checked_before_a_change() -> None:
    broken = replace(PENDULUM, rhs=lambda x, u: [x[1], 1 / 0], equations=None, parameters={})
    for bad in (broken, replace(PENDULUM.known(), A=np.eye(3)), replace(numbers(), W=[NAN, 1.0])):
        with pytest.raises(PlantDefinitionError, match=r"ZeroDivisionError|A has the shape|W of x1 is nan"):
            get_plant(bad, lambda plant: plant.changed({}, x_e=[0.1, 0.0]))
    inside = get_plant(
        numbers(), lambda plant: plant.changed({"x1": (2.0, 4.0), "u1": (-9.0, 9.0)}, x_e=[3.0, 0.0])
    )
    np.testing.assert_allclose(inside.u_e, [6.0])
    with pytest.raises(PlantDefinitionError, match="u_e of u1 is 6, but u_min of u1 is -3"):
        get_plant(numbers(), lambda plant: plant.changed({"x1": (2.0, 4.0)}, x_e=[3.0, 0.0]))


def test_equations_rest_under_a_known_wind() -> None:
    windy = QUADROTOR.varied(wind=2.0)
    with pytest.raises(ModelError, match=r"dvy/dt is 0.823 .* The nearest rest is x_e = \[.*resting_near"):
        build_model(windy, 0.02)
    rest = windy.resting_near()
    drift = np.array(rest.function()(rest.x_e, rest.u_e))
    np.testing.assert_allclose(drift, np.zeros((6, 1)), atol=1e-9)
    # It tilts into the wind and stays at the desired position.
    np.testing.assert_allclose(rest.x_e[[0, 1, 3, 4, 5]], np.zeros(5), atol=1e-12)
    assert rest.x_e[2] == pytest.approx(np.arctan(0.1 * 4 / (0.486 * 9.81)), abs=1e-9)
    assert rest.u_e[0] == pytest.approx(rest.u_e[1])
    assert rest.u_e[0] > QUADROTOR.u_e[0]
    assert faults(rest) == ()
    # The linearisation is the one at this rest.
    model = build_model(rest, 0.02)
    np.testing.assert_array_equal(model.plant.A, rest.linearised()[1])
    truth = Truth(rest)
    np.testing.assert_allclose(truth.step(rest.x_e, rest.u_e, 0.02), rest.x_e, atol=1e-9)


def test_another_level_is_held_by_another_inflow() -> None:
    other = TANKS.resting_near(x_e=[9.0, 14.0])
    np.testing.assert_allclose(np.array(other.function()(other.x_e, other.u_e)), np.zeros((2, 1)), atol=1e-9)
    assert np.abs(other.x_e - [9.0, 14.0]).max() < 1.0
    with pytest.raises(PlantDefinitionError, match="at the nearest rest: u_e of torque is"):
        replace(PENDULUM, u_max=np.array([0.5])).resting_near(x_e=[-0.3, 0.0])


# -- JSON -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "plant", [MOORE_GREITZER, INTEGRATOR, QUADROTOR, sampled(poles=(-1.0, -2.0))], ids=lambda p: p.name
)
def test_json_is_read_back_bit_for_bit(plant: Any) -> None:
    known = plant if isinstance(plant, Known) else plant.known()
    again = Known.from_builtins(json.loads(json.dumps(known.to_builtins(), allow_nan=False)))
    for one in fields(known):
        ours, its = getattr(known, one.name), getattr(again, one.name)
        if isinstance(ours, np.ndarray):
            np.testing.assert_array_equal(its, ours, strict=True)
        else:
            assert its == ours
            assert type(its) is type(ours)
    # A real pole stays real, because its exponential is computed by another function.
    assert [type(pole) for pole in again.poles or ()] == [type(pole) for pole in known.poles or ()]
    for name in ("A", "B", "K", "P"):
        period = known.period or 0.05
        np.testing.assert_array_equal(
            getattr(build_model(again, period), name), getattr(build_model(known, period), name)
        )


def test_one_and_one_point_zero_are_written_equally() -> None:
    with_point = sampled(period=1.0, poles=(-1.0, -2.0), scale={"u1": 1.0}).to_builtins()
    without = sampled(period=1, poles=(-1, -2), scale={"u1": 1}).to_builtins()
    assert json.dumps(without) == json.dumps(with_point)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"A": "words"}, "Expected `array`, got `str` - at `\\$.A`"),
        ({"shape": 1}, "unknown field `shape`"),
        ({"x_min": ["infinite", 0.0]}, "\\$.x_min\\[0\\]"),
        ({"names": 5}, "\\$.names"),
        ({"B": [[1.0]]}, r"B has the shape \(1, 1\)"),
        ({"performance": [7]}, "performance has 7"),
    ],
)
def test_other_data_is_not_read_as_a_plant(change: dict[str, Any], message: str) -> None:
    with pytest.raises(PlantDefinitionError, match=message):
        Known.from_builtins(numbers().to_builtins() | change)
    with pytest.raises(PlantDefinitionError, match="missing required field"):
        Known.from_builtins({})
