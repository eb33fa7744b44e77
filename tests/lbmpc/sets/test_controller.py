"""The controller with certified sets: it stays inside, returns from outside, and needs no solution for that."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from lbmpc.controller.signals import Observation
from lbmpc.controller.step import Controller
from lbmpc.oracles import DnnOracle
from lbmpc.problem import build_problem
from lbmpc.sets.certificate import Certificate, CertificateError
from lbmpc.sets.constraint_sets import state_set
from lbmpc.sets.construct import points_in
from lbmpc.sets.geometry.operations import body
from lbmpc.sets.invariance.approach import one_period
from lbmpc.solver.gauss_newton import Solver
from lbmpc.solver.solution import Solution, Status
from tests.helpers.plants.pendulum import pendulum
from tests.helpers.science import oracle_named

MODEL = pendulum()


def observation(x: np.ndarray, number: int) -> Observation:
    return Observation(x, None, 1, number, None)


@pytest.mark.parametrize("real_time", [False, True])
@pytest.mark.parametrize("theory", ["none", "random", "nan"])
def test_from_every_state_of_the_sets_the_controller_keeps_the_plant_inside(
    family: Certificate, theory: str, real_time: bool
) -> None:
    oracle = oracle_named("linear" if theory == "none" else "dnn", MODEL)
    problem = build_problem(MODEL, oracle, 8, "invariant", certificate=family)
    controller = Controller(problem, Solver(problem), real_time)
    rng, X = np.random.default_rng(4), state_set(MODEL)
    move = one_period(MODEL)
    guard = problem.guard
    assert guard is not None
    for index in (0, 0, len(family.pieces) - 1):
        piece = family.pieces[index]
        x = points_in(body(np.array(piece.G), np.array(piece.g)), 1, rng)[0]
        state = controller.initial_state(0)
        for number in range(25):
            if isinstance(oracle, DnnOracle):
                wild = rng.normal(scale=np.nan if theory == "nan" else 1e3, size=state.oracle["K"].shape)
                state.oracle["K"] = wild
            state, result = controller.step(state, observation(x, number))
            first = result.first
            assert first is not None
            assert first.lower is not None
            assert first.upper is not None
            u = result.plan[0]
            assert (first.lower <= u).all()
            assert (u <= first.upper).all()
            x = np.array(move(x, u)).ravel()
            assert X.contains(x)
            assert guard.first_inputs(x).piece >= 0


def test_outside_the_sets_it_reports_that_and_returns(family: Certificate) -> None:
    problem = build_problem(MODEL, oracle_named("linear", MODEL), 10, "invariant", certificate=family)
    controller = Controller(problem, Solver(problem))
    move = one_period(MODEL)
    # This state is outside every piece, but the plant can return from it.
    x = np.array([0.75, 0.0])
    state, pieces = controller.initial_state(0), []
    for number in range(40):
        state, result = controller.step(state, observation(x, number))
        assert result.mode == "solver"
        assert result.first is not None
        pieces.append(result.first.piece)
        assert (result.first.piece < 0) == (result.first.margin < 0)
        x = np.array(move(x, result.plan[0])).ravel()
    assert pieces[0] == -1
    assert pieces[-1] == 0
    assert abs(x[0]) < 0.2


def test_the_invariant_tightening_needs_sets() -> None:
    with pytest.raises(CertificateError, match="tandem sets compute"):
        build_problem(MODEL, oracle_named("linear", MODEL), 5, "invariant")


@pytest.mark.parametrize("wish", [-50.0, 50.0])
def test_the_first_input_stays_within_its_bounds_for_any_cost(wish: float) -> None:
    problem = build_problem(MODEL, oracle_named("linear", MODEL), 6)
    solver, first = Solver(problem), (np.array([-0.5]), np.array([0.2]))
    x, warm, nothing = np.array([0.01, 0.0]), np.zeros((6, 1)), np.zeros(0)
    bound = first[0][0] if wish < 0 else first[1][0]
    references = {"ur": np.full((6, 1), wish)}
    assert abs(solver.solve(x, nothing, warm, **references).v[0, 0]) > 0.5
    assert solver.solve(x, nothing, warm, **references, first=first).v[0, 0] == pytest.approx(bound, abs=1e-9)
    # The bounds apply to one solve only.
    assert abs(solver.solve(x, nothing, warm, **references).v[0, 0]) > 0.5
    solver.prepare(x, nothing, np.full((6, 1), 0.1))
    assert first[0][0] <= solver.feedback(np.array([-0.3 * np.sign(wish), 0.0]), first).v[0, 0] <= first[1][0]


class Failing:
    """A solver that finds its first solutions and none after them."""

    def __init__(self, real: Solver, good: int):
        self.real, self.good = real, good

    def solve(self, *arguments: Any, **named: Any) -> Solution:
        self.good -= 1
        found = self.real.solve(*arguments, **named)
        return found if self.good >= 0 else replace(found, status=Status.NUMERICAL)


@pytest.mark.parametrize("good", [0, 1])
def test_the_certificate_holds_without_a_solution(family: Certificate, good: int) -> None:
    # A feedback that destabilises the plant.
    model = replace(MODEL, K=-3.0 * MODEL.K)
    problem = build_problem(model, oracle_named("linear", model), 6, "invariant", certificate=family)
    rng, clipped = np.random.default_rng(8), 0
    base = body(np.array(family.pieces[0].G), np.array(family.pieces[0].g))
    states = points_in(base, 40, rng)
    for start, x in zip(states[::2], states[1::2], strict=True):
        controller = Controller(problem, Failing(Solver(problem), good))
        state = controller.initial_state(0)
        if good:
            state, _ = controller.step(state, observation(start, 0))
        wanted = state.plan.u[0] if good else np.clip(model.K @ x, -3.0, 3.0)
        # The plan was made for a distant state, so following it has no guarantee.
        _, result = controller.step(state, observation(x, 1))
        assert result.mode == ("shifted_plan" if good else "feedback")
        first = result.first
        assert first is not None
        assert first.lower is not None
        assert first.upper is not None
        assert first.lower[0] <= result.plan[0, 0] <= first.upper[0]
        clipped += bool(result.plan[0, 0] != wanted[0])
    assert clipped
