"""A step with rate limits and a weight on input changes, also without a solution."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from lbmpc.controller.backup_policy import BackupPlanner
from lbmpc.controller.fallback import empty_plan
from lbmpc.controller.state import ControllerState
from lbmpc.controller.step import Controller
from lbmpc.oracles import ConstantOracle
from lbmpc.problem import build_problem
from lbmpc.solver.gauss_newton import Solver
from tests.helpers.science import compressor
from tests.lbmpc.controller.test_step import CONTROLLER, X, same_memory, seen

RATE = 0.6
FREE = compressor()
STEP = RATE * FREE.period
MODEL = dataclasses.replace(
    FREE,
    plant=dataclasses.replace(FREE.plant, u_rate_max=np.array([RATE])),
    S=np.array([[0.2]]),
)
PROBLEM = build_problem(MODEL, ConstantOracle(4, 1, 0.5), 15, "first_step")
FAR = np.array([-0.3, -0.35, 0.0, 0.0])


def controller(real_time: bool = False) -> Controller:
    return Controller(PROBLEM, Solver(PROBLEM), real_time=real_time)


LIMITED = controller()


def within(plan: np.ndarray, acts: float) -> bool:
    return bool((np.abs(np.diff(plan[:, 0], prepend=acts)) <= STEP * (1 + 1e-9)).all())


@pytest.mark.parametrize("real_time", [False, True])
def test_a_plan_starts_from_the_present_input(real_time: bool) -> None:
    one, two = controller(real_time), controller(real_time)
    state = also = one.initial_state(0)
    active = 0
    for k, acts in enumerate((0.1, 0.12, -0.3, 0.4, 0.41)):
        one.prepare(state)
        x = FAR * 0.9**k
        state, result = one.step(state, seen(x, k, acts))
        assert result.mode == "solver"
        assert within(result.plan, acts)
        active += abs(abs(result.plan[0, 0] - acts) - STEP) < 1e-9
        # An unprepared step from a restored state gives the same result.
        also, again = two.step(ControllerState.from_arrays(also.to_arrays()), seen(x, k, acts))
        np.testing.assert_array_equal(result.plan, again.plan)
        assert same_memory(state, also) is None
    assert active >= 2


def test_fallback_inputs_keep_the_rate_limits() -> None:
    state, result = LIMITED.step(LIMITED.initial_state(0), seen(FAR, 0, 0.1))
    # Without a sample the plan continues from the commanded input.
    lost, without = LIMITED.step(state, seen(None, 1, None))
    assert without.mode == "shifted_plan"
    assert within(without.plan, result.plan[0, 0])
    # An unplanned input acts, and the numbers do not allow a solution.
    broken = dataclasses.replace(state, oracle={**state.oracle, "h_hat": np.full(4, np.nan)})
    _, other = LIMITED.step(broken, seen(np.full(4, 1e5), 1, -0.5))
    assert within(other.plan, -0.5)
    nothing = dataclasses.replace(lost, plan=empty_plan(15, 1))
    _, idle = LIMITED.step(nothing, seen(None, 2, None))
    assert idle.mode == "feedback"
    assert within(idle.plan, lost.commanded[0])
    # Before the first command the actuator has the safe input.
    _, begun = LIMITED.step(LIMITED.initial_state(0), seen(FAR, 0, None))
    assert within(begun.plan, float(MODEL.plant.safe_input[0] - MODEL.plant.u_e[0]))


def test_a_reported_input_outside_u_keeps_the_plan_in_u() -> None:
    state, _ = LIMITED.step(LIMITED.initial_state(0), seen(FAR, 0, 0.1))
    _, other = LIMITED.step(state, seen(None, 1, 1e3))
    assert other.mode == "shifted_plan"
    low, high = MODEL.plant.u_min - MODEL.plant.u_e, MODEL.plant.u_max - MODEL.plant.u_e
    assert ((other.plan >= low) & (other.plan <= high)).all()


def test_an_oracle_with_nan_gives_finite_commands() -> None:
    state, _ = LIMITED.step(LIMITED.initial_state(0), seen(FAR, 0, 0.1))
    broken = {**state.oracle, "h_hat": np.full(4, np.nan)}
    for plan in (state.plan, empty_plan(15, 1)):
        blind = dataclasses.replace(state, plan=plan, oracle=broken, delay=0.01)
        after, result = LIMITED.step(blind, seen(FAR, 5, 0.1))
        assert within(result.plan, 0.1)
        assert np.isfinite(after.predicted).all()


def test_a_backup_plan_continues_from_the_command() -> None:
    state, result = LIMITED.step(LIMITED.initial_state(0), seen(FAR, 0, 0.1))
    policy = LIMITED.backup(BackupPlanner(PROBLEM, 0.0075), state)
    assert policy is not None
    planned = policy.inputs + policy.states @ policy.gain.T
    assert within(planned, result.plan[0, 0])


def test_without_rate_limits_no_input_is_stored() -> None:
    state, _ = CONTROLLER.step(CONTROLLER.initial_state(0), seen(X, 0, None))
    assert "commanded" not in state.to_arrays()
    assert "commanded" in LIMITED.initial_state(0).to_arrays()
