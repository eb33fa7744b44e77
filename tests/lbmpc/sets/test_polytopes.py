"""Polytopes, tubes and the terminal set."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from lbmpc.oracles import LinearOracle
from lbmpc.problem import build_problem, disturbance_set, input_set, state_set
from lbmpc.sets.geometry.polytope import EmptySetError, Polytope
from lbmpc.sets.invariance.terminal import terminal_set
from lbmpc.sets.invariance.tube import tube_margins
from tests.helpers.science import compressor

MODEL = compressor()
SMALL = np.array([0.003, 0.0005, 1e-5, 1.1e-4])


def test_support_of_a_box_and_of_the_same_set_as_rows_agree() -> None:
    rng = np.random.default_rng(0)
    box = Polytope.box(np.array([-1.0, 0.0, -3.0]), np.array([2.0, 1.0, -1.0]), ("a", "b", "c"))
    doubled = Polytope(np.vstack([box.F, box.F]), np.tile(box.lower, 2), np.tile(box.upper, 2), box.names * 2)
    for _ in range(20):
        direction = rng.normal(size=3)
        assert doubled.support(direction) == pytest.approx(box.support(direction), abs=1e-9)


def test_an_unbounded_or_empty_set_is_recognised() -> None:
    half = Polytope(np.array([[1.0, 0.0], [1.0, 1.0]]), np.full(2, -np.inf), np.ones(2), ("a", "b"))
    assert half.support(np.array([-1.0, 0.0])) == np.inf
    empty = Polytope(np.array([[1.0], [1.0]]), np.array([1.0, -np.inf]), np.array([np.inf, 0.0]), ("a", "b"))
    with pytest.raises(EmptySetError):
        empty.support(np.array([1.0]))
    assert empty.interior_point() is None


def test_the_tube_contains_every_disturbed_deviation_and_is_tight() -> None:
    rng = np.random.default_rng(1)
    closed, w = MODEL.closed_loop, disturbance_set(MODEL, SMALL)
    F = np.vstack([np.eye(4), MODEL.K])
    low, high = tube_margins(F, closed, w, 30)
    reached = np.zeros((31, len(F)))
    for _ in range(200):
        e = np.zeros(4)
        for i in range(31):
            assert (F @ e <= high[i] + 1e-12).all()
            assert (-F @ e <= low[i] + 1e-12).all()
            reached[i] = np.maximum(reached[i], F @ e)
            e = closed @ e + rng.choice([-1.0, 1.0], 4) * SMALL
    # The worst disturbance for one row is known in closed form, and the tube must attain it.
    for row in range(len(F)):
        worst = sum(np.abs(F[row] @ np.linalg.matrix_power(closed, k)) @ SMALL for k in range(30))
        assert high[30, row] == pytest.approx(worst)


def test_the_terminal_set_is_disturbance_invariant_and_inside() -> None:
    rng = np.random.default_rng(2)
    omega = terminal_set(MODEL, state_set(MODEL), input_set(MODEL), disturbance_set(MODEL, SMALL))
    rows, bounds = omega.one_sided()
    found = 0
    for _ in range(300):
        # Boundary points along random directions from the origin.
        direction = rng.normal(size=4) * [0.3, 0.3, 0.5, 5.0]
        x = direction / (rows @ direction / bounds).max()
        assert omega.contains(x, 1e-9)
        assert state_set(MODEL).contains(x, 1e-9)
        assert input_set(MODEL).contains(MODEL.K @ x, 1e-9)
        for corner in rng.choice([-1.0, 1.0], (8, 4)):
            assert omega.contains(MODEL.closed_loop @ x + corner * SMALL, 1e-8)
            found += 1
    assert found


def test_an_empty_tightening_names_step_constraint_and_margin() -> None:
    # h over all of X x U. The notes of the example say that no tube exists for it.
    full = np.array([0.0144, 0.0148, 1.1e-4, 1.1e-4])
    with pytest.raises(EmptySetError, match=r"step \d+: state [zy] .* crosses by 0\.\d+"):
        build_problem(MODEL, LinearOracle(4, 1), 60, "tube", full)
    with pytest.raises(EmptySetError, match="no robust positively invariant set"):
        terminal_set(MODEL, state_set(MODEL), input_set(MODEL), disturbance_set(MODEL, full))
    with pytest.raises(EmptySetError, match=r"step 1: state y .* crosses by 0\.2"):
        build_problem(MODEL, LinearOracle(4, 1), 60, "first_step", np.array([0.0, 0.6, 0.0, 0.0]))


def test_first_step_tightens_only_the_first_step() -> None:
    problem = build_problem(MODEL, LinearOracle(4, 1), 5, "first_step", SMALL)
    plain = state_set(MODEL)
    np.testing.assert_allclose(problem.states[0].lower, plain.lower + SMALL)
    np.testing.assert_allclose(problem.states[0].upper, plain.upper - SMALL)
    for later in problem.states[1:]:
        np.testing.assert_array_equal(later.lower, plain.lower)
    assert problem.soft


def test_the_tube_is_hard_and_shrinks() -> None:
    problem = build_problem(MODEL, LinearOracle(4, 1), 20, "tube", SMALL)
    assert not problem.soft
    widths = [set_.upper[1] - set_.lower[1] for set_ in problem.states]
    assert all(a > b for a, b in itertools.pairwise(widths))
    assert len(problem.states[-1].F) > 4
    assert problem.inputs[-1].upper[0] < problem.inputs[0].upper[0] == input_set(MODEL).upper[0]


def test_the_tube_is_recursively_feasible_under_the_worst_disturbances() -> None:
    """From a feasible state, under random corner disturbances, the problem stays feasible and X is kept."""
    from lbmpc.solver.gauss_newton import Solver, Status

    rng = np.random.default_rng(5)
    problem = build_problem(MODEL, LinearOracle(4, 1), 15, "tube", SMALL)
    solver, plain = Solver(problem), state_set(MODEL)
    for start in ([0.1, 0.1, 0.0, 0.0], [-0.1, -0.12, 0.0, 0.0], [0.3, 0.2, 0.1, 0.0]):
        x, v = np.array(start), np.zeros((15, 1))
        assert solver.solve(x, np.zeros(0), v).status is Status.CONVERGED
        for _ in range(60):
            solution = solver.solve(x, np.zeros(0), v)
            assert solution.status is Status.CONVERGED
            x = MODEL.A @ x + MODEL.B @ solution.v[0] + rng.choice([-1.0, 1.0], 4) * SMALL
            assert plain.contains(x, 1e-9)
            v = np.vstack([solution.v[1:], np.zeros((1, 1))])
