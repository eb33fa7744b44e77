"""One control step: learn, adopt, solve, plan; and steps with missing parts."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from lbmpc.controller.signals import Observation
from lbmpc.controller.state import ControllerState
from lbmpc.controller.step import Controller
from lbmpc.oracles import DnnOracle
from lbmpc.oracles.base import HiddenSet, Verdict
from lbmpc.plants.linear_motion import discretise
from lbmpc.problem import build_problem
from lbmpc.references import Reference
from lbmpc.solver.gauss_newton import Solver
from lbmpc.solver.solution import Solution, Status
from lbmpc.targets import TargetSelector
from network_model.description import hash_layers
from tests.helpers.science import compressor, describe, features

MODEL = compressor()
ORACLE = DnnOracle(describe(MODEL, [8, 8]))
PROBLEM = build_problem(MODEL, ORACLE, 15, "first_step")
CONTROLLER = Controller(PROBLEM, Solver(PROBLEM))
TO_Y = Reference((1,), np.zeros(1), np.array([[0.05]]))
X = np.array([0.05, 0.05, 0.0, 0.0])
X_NEXT = np.array([0.052, 0.049, 0.01, 0.1])


def seen(x: np.ndarray | None, sequence: int, applied: float | None = 0.1, **more) -> Observation:
    given = None if applied is None else np.array([applied])
    return Observation(x, given, more.get("source", 1), sequence, more.get("hidden"))


def offered(shift: float, version: int = 1) -> HiddenSet:
    hidden = ORACLE.hidden(CONTROLLER.initial_state(0).oracle)
    layers = [(layer + shift).astype(np.float32).astype(float) for layer in hidden]
    return HiddenSet(version, layers, hash_layers(layers), ORACLE.description.sha256())


def same_memory(a: ControllerState, b: ControllerState) -> str | None:
    """Return the name of the first array that differs between two states, bit for bit, or None."""
    left, right = a.to_arrays(), b.to_arrays()
    for name in sorted(left.keys() | right.keys()):
        if name not in left or name not in right or left[name].tobytes() != right[name].tobytes():
            return name
    return None


def test_the_label_uses_the_applied_input() -> None:
    state, first = CONTROLLER.step(CONTROLLER.initial_state(0), seen(X, 0, None))
    assert first.label is None
    _, second = CONTROLLER.step(state, seen(X_NEXT, 1, applied=0.3))
    assert second.label is not None
    np.testing.assert_allclose(second.label.h, X_NEXT - MODEL.A @ X - MODEL.B @ [0.3])
    np.testing.assert_array_equal(second.label.u, [0.3])
    assert abs(first.plan[0, 0] - 0.3) > 0.05


def test_a_swap_learns_the_old_label_with_the_old_features() -> None:
    """The set arrives together with x_{t+1}, but the label of u_t belongs to phi_j, not to phi_{j+1}."""
    state, _ = CONTROLLER.step(CONTROLLER.initial_state(0), seen(X, 0, None))
    plain, _ = CONTROLLER.step(state, seen(X_NEXT, 1))
    swapped, result = CONTROLLER.step(state, seen(X_NEXT, 1, hidden=offered(0.5)))
    assert result.verdict == Verdict("adopted")
    np.testing.assert_array_equal(swapped.oracle["K"], plain.oracle["K"])
    assert not np.array_equal(swapped.oracle["W1"], plain.oracle["W1"])
    # From then on the new features are used.
    after = CONTROLLER.step(swapped, seen(X, 2))[0].oracle["K"]
    assert not np.array_equal(after, CONTROLLER.step(plain, seen(X, 2))[0].oracle["K"])
    phi = features(ORACLE, swapped.oracle, X_NEXT, np.array([0.1]))
    h = X - MODEL.A @ X_NEXT - MODEL.B @ [0.1]
    error = swapped.oracle["K"].T @ phi - h / ORACLE.output_scale
    expected = swapped.oracle["K"] - ORACLE.gamma * np.outer(phi, error) / (phi @ phi)
    norms = np.linalg.norm(expected, axis=0)
    np.testing.assert_allclose(after, expected * np.minimum(1, ORACLE.bounds / norms), atol=1e-12)


def test_a_label_needs_two_consecutive_samples_of_one_plant_and_a_known_input() -> None:
    state, _ = CONTROLLER.step(CONTROLLER.initial_state(0), seen(X, 4, None))
    for observation in (
        seen(X_NEXT, 6),
        seen(X_NEXT, 4),
        seen(X_NEXT, 5, None),
        seen(X_NEXT, 5, source=2),
        seen(None, 5),
    ):
        after, result = CONTROLLER.step(state, observation)
        assert result.label is None
        np.testing.assert_array_equal(after.oracle["K"], state.oracle["K"])
    # A missing state interrupts the sequence, so the sample after it has no label either.
    gone, _ = CONTROLLER.step(state, seen(None, 5))
    assert CONTROLLER.step(gone, seen(X_NEXT, 5))[1].label is None


def test_a_refused_set_is_reported_and_the_old_one_stays() -> None:
    state = CONTROLLER.initial_state(0)
    broken = offered(0.1)
    broken.layers[0][0, 0] = np.nan
    after, result = CONTROLLER.step(state, seen(X, 0, None, hidden=broken))
    assert result.verdict == Verdict("refused", "layer 1 is not finite")
    assert result.mode == "solver"
    np.testing.assert_array_equal(after.oracle["W1"], state.oracle["W1"])
    assert CONTROLLER.step(after, seen(X_NEXT, 1, hidden=offered(0.1)))[1].verdict == Verdict("adopted")


class Failing:
    """The real solver for some calls, and a solver without solutions after that."""

    def __init__(self, good: int):
        self.good, self.real = good, Solver(PROBLEM)

    def solve(
        self, x: np.ndarray, theta: np.ndarray, warm_start: np.ndarray, *more: Any, **named: Any
    ) -> Solution:
        self.good -= 1
        if self.good >= 0:
            return self.real.solve(x, theta, warm_start, *more, **named)
        nothing = np.zeros_like(warm_start)
        return Solution(
            Status.NUMERICAL, nothing, nothing, nothing, np.zeros((len(nothing), 4)), np.inf, 0, 0.0, ""
        )


def test_without_a_solution_the_shifted_plan_and_then_K_act() -> None:
    controller = Controller(PROBLEM, Failing(1))
    state, first = controller.step(controller.initial_state(0), seen(X, 0, None))
    assert first.mode == "solver"
    for i in range(1, 15):
        state, result = controller.step(state, seen(X_NEXT, i))
        assert result.mode == "shifted_plan"
        assert result.solution is not None
        assert result.solution.status is Status.NUMERICAL
        np.testing.assert_array_equal(result.plan[0], first.plan[i])
    _, result = controller.step(state, seen(X_NEXT, 15))
    assert result.mode == "feedback"
    np.testing.assert_allclose(result.plan[0], MODEL.K @ X_NEXT)
    assert result.plan.shape == (15, 1)


def test_without_a_state_the_plan_continues_and_without_both_the_equilibrium_input_acts() -> None:
    state, first = CONTROLLER.step(CONTROLLER.initial_state(0), seen(X, 0, None))
    _, result = CONTROLLER.step(state, seen(None, -1))
    assert result.mode == "shifted_plan"
    np.testing.assert_array_equal(result.plan[0], first.plan[1])
    _, result = CONTROLLER.step(CONTROLLER.initial_state(0), seen(np.full(4, np.nan), 0, None))
    assert result.mode == "feedback"
    np.testing.assert_array_equal(result.plan, np.zeros((15, 1)))


@pytest.mark.parametrize("absurd", [1.7e308, 1e307, -1e160, 3e6])
def test_an_absurd_measurement_counts_as_missing(absurd: float) -> None:
    """The number is finite, but the learned weights would not be, and nonfinite weights would stay in the memory."""
    state = CONTROLLER.initial_state(0)
    for i in range(3):
        state, _ = CONTROLLER.step(state, late(X, i, 0.1, 0.004, 0.1))
    wrong = late(np.array([X[0], absurd, *X[2:]]), 3, 0.1, 0.004, 0.1)
    after, result = CONTROLLER.step(state, wrong)
    assert result.mode == "shifted_plan"
    assert result.label is None
    without, _ = CONTROLLER.step(state, replace(wrong, x=None))
    assert same_memory(after, without) is None
    _, result = CONTROLLER.step(after, late(X_NEXT, 4, 0.1, 0.004, 0.1))
    assert result.mode == "solver"


@pytest.mark.parametrize("absurd", [1.7e308, -1e160, 3e6])
@pytest.mark.parametrize("which", [0, 1])
def test_an_absurd_input_counts_as_unknown(absurd: float, which: int) -> None:
    """The number is finite, but the prediction over the delay would not be."""
    state = CONTROLLER.initial_state(0)
    for i in range(3):
        state, _ = CONTROLLER.step(state, late(X, i, 0.1, 0.004, 0.1))
    good = late(X, 3, 0.1, 0.004, 0.1)
    pieces = tuple(
        (seconds, np.array([absurd]) if i == which else u) for i, (seconds, u) in enumerate(good.pieces)
    )
    after, result = CONTROLLER.step(state, replace(good, pieces=pieces))
    assert np.isfinite(result.plan).all()
    without, _ = CONTROLLER.step(state, replace(good, applied=None, pieces=()))
    assert same_memory(after, without) is None
    _, result = CONTROLLER.step(after, late(X_NEXT, 4, 0.1, 0.004, 0.1))
    assert result.mode == "solver"


def test_learning_from_a_wild_measurement_stays_finite() -> None:
    state = CONTROLLER.initial_state(0)
    half = 0.5 * (MODEL.plant.x_max - MODEL.plant.x_min)
    for i in range(4):
        x = 9e5 * half if i == 2 else X
        state, result = CONTROLLER.step(state, late(x, i, 0.1, 0.004, 0.1))
        assert all(np.isfinite(array).all() for array in state.to_arrays().values())
    assert result.mode == "solver"


def test_the_feedback_is_clipped_to_U() -> None:
    controller = Controller(PROBLEM, Failing(0))
    _, result = controller.step(controller.initial_state(0), seen(np.array([0.5, -0.5, 0, 0]), 0, None))
    assert result.mode == "feedback"
    low, high = MODEL.plant.u_min - MODEL.plant.u_e, MODEL.plant.u_max - MODEL.plant.u_e
    assert (result.plan >= low).all()
    assert (result.plan <= high).all()
    assert abs(float((MODEL.K @ [0.5, -0.5, 0, 0])[0])) > high[0]


def test_the_feedback_holds_the_target() -> None:
    """K pulls the nominal model towards the target: there the input is the target's, and elsewhere K adds to it."""
    controller = Controller(PROBLEM, Failing(0), targets=TargetSelector(PROBLEM), reference=TO_Y)
    state = controller.initial_state(0)
    _, probe = controller.step(state, seen(X, 0, None))
    assert probe.target is not None
    xs, us = probe.target.xu[:4], probe.target.xu[4:]
    assert abs(xs[1] - 0.05) < 1e-6
    for off in (np.zeros(4), np.array([0.01, -0.02, 0.0, 0.0])):
        _, result = controller.step(state, seen(xs + off, 0, None))
        assert result.mode == "feedback"
        np.testing.assert_allclose(result.plan[0], us + MODEL.K @ off, atol=1e-12)


def test_the_memory_is_saved_and_restored_bit_for_bit() -> None:
    state = CONTROLLER.initial_state(0)
    for i in range(5):
        state, _ = CONTROLLER.step(state, seen(X + 0.001 * i, i))
    thawed = ControllerState.from_arrays({name: array.copy() for name, array in state.to_arrays().items()})
    assert same_memory(state, thawed) is None
    a, _ = CONTROLLER.step(state, seen(X, 5))
    b, _ = CONTROLLER.step(thawed, seen(X, 5))
    assert same_memory(a, b) is None
    assert same_memory(a, state) is not None


def test_only_the_seed_determines_the_initial_state() -> None:
    assert same_memory(CONTROLLER.initial_state(3), CONTROLLER.initial_state(3)) is None
    assert same_memory(CONTROLLER.initial_state(3), CONTROLLER.initial_state(4)) == "oracle.K"


def late(x: np.ndarray, sequence: int, first: float, delay: float, then: float) -> Observation:
    """Return a sample whose period began with the input `first` and continued with `then` after `delay` seconds."""
    pieces = ((delay, np.array([first])), (0.05 - delay, np.array([then])))
    mean = (delay * first + (0.05 - delay) * then) / 0.05
    return Observation(x, np.array([mean]), 1, sequence, None, pieces)


def test_the_problem_starts_at_the_state_where_the_command_acts() -> None:
    """For a linear true plant and a constant delay the prediction equals the true motion."""
    delay, x, acting = 0.004, np.array([0.1, 0.05, 0.0, 0.0]), 0.0
    state = CONTROLLER.initial_state(0)
    state = ControllerState.from_arrays(state.to_arrays() | {"oracle.K": np.zeros_like(state.oracle["K"])})
    commanded, errors = 0.0, []
    for i in range(60):
        seen_now = seen(x, 0, None) if i == 0 else late(x, i, acting, delay, commanded)
        acting = commanded
        state, result = CONTROLLER.step(state, seen_now)
        before, commanded = state.predicted, float(result.plan[0, 0])
        x = MODEL.A @ x + (
            MODEL.within.answer(((delay, np.array([acting])), (0.05 - delay, np.array([commanded]))))
        )
        # The state at which the next command acts, with this one until then.
        phi, gamma = discretise(MODEL.plant.A, MODEL.plant.B, delay)
        errors.append(np.abs(phi @ x + gamma @ [commanded] - before).max())
    assert abs(state.delay - delay) < 1e-6
    assert max(errors[40:]) < 1e-6
    assert max(errors[:3]) > 1e-4


def test_in_lock_step_there_is_no_delay() -> None:
    state = CONTROLLER.initial_state(0)
    for i in range(4):
        state, result = CONTROLLER.step(state, seen(X, i))
        assert result.delay == 0.0


@pytest.mark.parametrize("delay", [0.002, 0.01, 0.025])
def test_a_configured_delay_is_predicted_from_the_first_tick_on(delay: float) -> None:
    """The first period is not whole: the plant was held until the first command and reports the input since then."""
    controller = Controller(PROBLEM, Solver(PROBLEM), input_delay=delay)
    state = controller.initial_state(0)
    state = ControllerState.from_arrays(state.to_arrays() | {"oracle.K": np.zeros_like(state.oracle["K"])})
    state, first = controller.step(state, seen(X, 0, None))
    assert first.delay == pytest.approx(delay)
    x = MODEL.ahead(X, first.plan[0], 0.05 - delay)
    part = Observation(x, None, 1, 1, None, ((0.05 - delay, first.plan[0]),))
    state, second = controller.step(state, part)
    assert second.delay == pytest.approx(delay)
    assert second.label is None
    where = MODEL.ahead(x, first.plan[0], delay)
    after = MODEL.step(where, second.plan[0])
    assert state.predicted[:4] == pytest.approx(after, abs=1e-9)


def test_the_initial_delay_is_at_most_half_a_period() -> None:
    assert Controller(PROBLEM, Solver(PROBLEM), input_delay=0.2).initial_state(0).delay == 0.025
    assert CONTROLLER.initial_state(0).delay == 0.0
