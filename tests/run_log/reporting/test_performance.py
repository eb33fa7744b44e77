"""The performance figures of motions that are known in closed form."""

from __future__ import annotations

import dataclasses
from typing import Any

import msgspec
import numpy as np
import pytest

from lbmpc.plants.equations import Plant
from node_runtime.config.loading import override
from node_runtime.config.plant import true_dead_time
from node_runtime.config.sections import Config
from run_log.reporting.between_samples import behind
from run_log.reporting.motion import Trajectory
from run_log.reporting.performance import Performance, performance

TURN = 2 * np.pi
OSCILLATOR = Plant(
    name="oscillator",
    states=("position", "speed"),
    inputs=("push",),
    units={"position": "m", "speed": "m/s", "push": "m/s^2", "t": "s"},
    rhs=lambda x, u: [x[1], u[0] - x[0]],
    x_e=[0, 0],
    u_e=[0],
    x_min=[-1, -0.5],
    x_max=[1, 0.5],
    u_min=[-1],
    u_max=[1],
    W=[0, 0],
    x0=[0.9, 0],
    safe_input=[0],
    performance=[0, 1],
    kernel=["push"],
)


def motion(x: Any, applied: Any = 0.0, period: float = 1.0, pieces: Any = None) -> Trajectory:
    """x: (n, d); applied: the input over the periods between the samples."""
    x = np.array(x, dtype=float)
    inputs = np.vstack([[np.nan], np.broadcast_to(np.reshape(applied, (-1, 1)), (len(x) - 1, 1))])
    known = pieces or tuple(((period, (u,)),) for u in inputs[1:, 0])
    step = np.arange(len(x))
    return Trajectory(step, period * step, x, inputs, ((), *known))


def figures(
    given: Trajectory, *settings: str, plant: Plant = OSCILLATOR, truth: Plant | None = None
) -> Performance:
    return performance(given, plant, override(Config(), list(settings)), truth or plant)


def test_figures_are_about_the_reference_of_each_sample() -> None:
    goal = np.array([[0.0, 0.0], [0.5, 0.0], [0.5, 0.0]])
    x = [[0.1, 0.0], [0.5, 0.0], [0.45, 0.0]]
    found = figures(msgspec.structs.replace(motion(x), goal=goal), "rate=1")
    assert found.J == pytest.approx(0.01)
    assert found.deviation == pytest.approx(0.01)
    assert found.offset == {"position": pytest.approx(0.05)}
    assert set(found.overshoot.values()) == {None}
    assert figures(motion(x), "rate=1").offset == {}


def test_the_input_may_have_a_goal_too() -> None:
    given = motion([[0.1, 0.0], [0.2, 0.1], [0.9, 0.9]], [0.3, -0.3], 1.0)
    given = msgspec.structs.replace(given, goal=np.array([[0.1, 0.0], [0.2, 0.0], [0.2, 0.0]]))
    weights = ["rate=1", "controller.Q=[2.0, 3.0]", "controller.R=[0.5]"]
    found = performance(given, OSCILLATOR, override(Config(), weights), OSCILLATOR, np.array([[0.3], [-0.3]]))
    assert found.J == pytest.approx(3 * 0.01)


def test_J_is_the_integral_of_the_densities_at_every_rate() -> None:
    x = [[0.5, 0.1], [-0.25, 0.2], [0.0, 0.0]]
    weights = ["controller.Q=[2.0, 3.0]", "controller.R=[0.5]"]
    found = figures(motion(x, [0.4, -0.8], 0.5), "rate=2", *weights)
    states, inputs = 2 * (0.25 + 0.0625) + 3 * (0.01 + 0.04), 0.5 * (0.16 + 0.64)
    assert found.J == pytest.approx(0.5 * (states + inputs))
    # The same motion, sampled twice as often.
    twice = np.repeat(x, 2, axis=0)[:-1]
    fine = figures(motion(twice, np.repeat([0.4, -0.8], 2), 0.25), "rate=4", *weights)
    assert fine.J == pytest.approx(found.J)
    assert fine.deviation == pytest.approx(found.deviation) == pytest.approx(0.5 * (0.26 + 0.1025))


def test_J_includes_a_missing_sample_and_excludes_an_unknown_input() -> None:
    given = motion([[0.5, 0.0], [0.25, 0.0], [0.0, 0.0]], [0.4, np.nan])
    assert figures(given, "rate=1").J == pytest.approx(0.25 + 0.16 + 0.0625)
    gap = msgspec.structs.replace(given, step=np.array([0, 1, 3]))
    assert figures(gap, "rate=1").J == pytest.approx(0.25 + 0.16 + 2 * 0.0625)


def test_overshoot_is_a_share_of_the_state_s_own_initial_deviation_on_the_other_side() -> None:
    found = figures(motion([[-0.8, 0.4], [-0.9, 0.2], [0.2, 0.01], [0.0, 0.0]]))
    assert found.overshoot == {"position": pytest.approx(0.25), "speed": 0.0}
    # 4 % of the half-width of 0.5 is 0.02.
    found = figures(motion([[0.0, 0.02], [-0.9, -0.2], [0.2, 0.01]]))
    assert found.overshoot == {"position": None, "speed": None}


def test_settling_is_per_state_in_half_widths_and_missing_if_one_is_off_at_the_end() -> None:
    x = [[0.9, 0.3], [0.041, 0.019], [0.039, -0.021], [0.0, 0.0], [0.04, 0.02]]
    found = figures(motion(x, period=0.1), "rate=10")
    assert found.settled_by_state_s == {"position": 0.2, "speed": 0.3}
    assert found.settled_s == 0.3
    found = figures(motion([*x, [0.0, 0.03]], period=0.1), "rate=10")
    assert found.settled_by_state_s == {"position": 0.2, "speed": None}
    assert found.settled_s is None


def test_a_violation_is_a_share_of_the_half_width() -> None:
    small = dataclasses.replace(
        OSCILLATOR, x_min=np.full(2, -1e-6), x_max=np.full(2, 1e-6), u_min=[-1e3], u_max=[1e3]
    )
    found = figures(motion([[1.26e-6, 0.0], [1.00001e-6, 0.0], [1e-6, 0.0]]), plant=small)
    assert found.constraint_violations == 2
    assert figures(motion(np.zeros((3, 2)), [1e3 + 5e-4, 1e3 + 2e-3]), plant=small).constraint_violations == 1


def test_rows_beside_the_boxes_are_counted_by_name() -> None:
    rows = {"sum": {"position": 1.0, "speed": 1.0, "max": 0.5}, "force": {"push": 2.0, "max": 1.0}}
    plant = dataclasses.replace(OSCILLATOR, rows=rows)
    given = motion([[0.3, 0.1], [0.3, 0.3], [0.4, 0.4], [0.0, 0.0]], [0.0, 0.6, 0.0])
    found = figures(given, plant=plant)
    assert found.violated_rows == {"sum": 2, "force": 1}
    assert found.constraint_violations == 2
    assert figures(given).violated_rows == {}
    still = motion([[0.4, 0.4]] * 3, period=0.0)
    assert figures(still, plant=plant).excess_between_samples == pytest.approx(0.3 / 1.5)


def test_the_motion_between_samples_is_that_of_the_truth() -> None:
    # One revolution per period: the samples do not show it, and after a quarter of it the speed is 0.9.
    around = motion([[0.9, 0.0]] * 3, period=TURN)
    found = figures(around, f"rate={1 / TURN}")
    assert found.constraint_violations == 0
    assert found.excess_between_samples == pytest.approx((0.9 - 0.5) / 0.5, abs=1e-7)
    inside = motion([[0.4, 0.0]] * 3, period=TURN)
    assert figures(inside).excess_between_samples == 0.0
    # A sample outside counts too: the last one, after which the motion is not known.
    assert figures(motion([[0.9, 0.0]] * 3, period=0.0)).excess_between_samples == 0.0
    assert figures(motion([[1.5, 0.0]] * 3, period=0.0)).excess_between_samples == pytest.approx(0.5)


def test_the_inputs_of_a_period_act_in_turn() -> None:
    # Half a turn about 0.3, half a turn about -0.3: from 0 to 0.6 to -1.2.
    turns = (((TURN / 2, (0.3,)), (TURN / 2, (-0.3,))), ((TURN / 2, (0.0,)),))
    given = motion([[0.0, 0.0], [-1.2, 0.0], [1.2, 0.0]], pieces=turns)
    assert figures(given).excess_between_samples == pytest.approx((1.2 - 0.5) / 0.5, abs=1e-7)


def test_with_a_dead_time_earlier_inputs_act() -> None:
    # As above, a quarter of a turn later; the input before that is not known.
    turns = (((TURN / 2, (0.3,)), (TURN / 2, (-0.3,))), ((TURN / 2, (0.0,)), (TURN / 2, (0.1,))))
    late = override(Config(), [f"rate={1 / TURN}", f"plant.truth.dead_time={TURN / 4}"])
    given = motion([[0.9, 0.9], [0.3, -0.3], [0.0, 0.0]], pieces=turns)
    acted = behind(given, true_dead_time(late, OSCILLATOR, OSCILLATOR)).pieces
    assert acted[:2] == ((), ())
    shares = [(round(seconds / TURN, 12), u) for seconds, (u,) in acted[2]]
    assert shares == [(0.25, -0.3), (0.5, 0.0), (0.25, 0.1)]
    # After a missing sample a new line begins.
    lossy = motion([[0.0, 0.0]] * 5, pieces=(turns[0], (), turns[0], turns[1]))
    assert [bool(one) for one in behind(lossy, TURN / 4).pieces] == [False, False, False, False, True]
    assert behind(given, 0.0) is given


def test_an_unknown_truth_gives_no_figure() -> None:
    around = motion([[0.4, 0.0]] * 3, period=TURN)
    damped = dataclasses.replace(OSCILLATOR, rhs=lambda x, u: [x[1], u[0] - x[0] - 0.1 * x[1]])
    assert figures(around, truth=damped).excess_between_samples is None
    assert figures(motion(around.x, pieces=((), ()))).excess_between_samples is None
    assert figures(motion([[0.4, 0.0]])).excess_between_samples is None


def test_a_fast_truth_is_integrated_in_short_steps() -> None:
    fast = dataclasses.replace(OSCILLATOR, rhs=lambda x, u: [x[1], 300.0 * (0.3 - x[1])])
    short = 0.01 / 300.0
    given = motion([[0.0, 0.29], [0.6 - short, 0.3], [1.2 - short, 0.3]], period=2.0)
    assert figures(given, plant=fast).excess_between_samples == pytest.approx(0.2, abs=1e-4)
    blows_up = dataclasses.replace(OSCILLATOR, rhs=lambda x, u: [x[1], x[0] ** 2 * 1e9])
    assert figures(motion([[0.4, 0.0]] * 3), truth=blows_up).excess_between_samples is None


def test_a_plant_that_was_lost_has_finite_figures() -> None:
    found = figures(motion([[0.9, 0.0], [1e200, -1e308]], 1e300), "controller.Q=[0.0, 1.0]")
    assert np.isfinite(found.J)
    assert np.isfinite(found.deviation)
    assert found.settled_s is None


def test_figures_of_the_parts_of_a_run() -> None:
    x = [[0.9, 0.3], [0.5, 0.0], [-0.1, 0.0], [0.5, 0.3], [0.2, 0.1], [0.0, 0.0]]
    whole = motion(x, [0.1, 0.2, 1.5, 0.4, 0.5])
    # The plant is reset between the third and the fourth sample, with an input of neither part.
    first, second = whole.part(0, 2), whole.part(3, 5)
    assert figures(first, "rate=1").J + figures(second, "rate=1").J == pytest.approx(
        figures(whole, "rate=1").J - 0.1**2 - 1.5**2
    )
    assert figures(second).constraint_violations == 0
    assert figures(second, "rate=1").settled_by_state_s == {"position": 2.0, "speed": 2.0}
    assert figures(second).overshoot == {"position": 0.0, "speed": 0.0}
    assert figures(first).overshoot["position"] == pytest.approx(1 / 9)
