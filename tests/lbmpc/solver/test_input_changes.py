"""Rate limits of inputs and the cost of changes, compared with IPOPT."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from lbmpc.model import Model, build_model
from lbmpc.oracles import DnnOracle, LinearOracle
from lbmpc.plants import get_plant
from lbmpc.problem import build_problem
from lbmpc.sets.certificate import CertificateError
from lbmpc.solver.gauss_newton import Solver
from lbmpc.solver.solution import Status
from tests.helpers.ipopt_reference import ReferenceSolver
from tests.helpers.rescaled import rescaled
from tests.helpers.science import describe
from tests.lbmpc.solver.test_other_plants import random_case

COMPRESSOR = get_plant("moore_greitzer")
EXACT = 1e-9
"""Share of the allowed step by which the sum of two numbers is rounded."""


def with_rates(model: Model, rates: np.ndarray, S: np.ndarray) -> Model:
    """Return the same model with other rate limits, (m,), and weights of changes between stages, (m,)."""
    return dataclasses.replace(model, plant=dataclasses.replace(model.plant, u_rate_max=rates), S=np.diag(S))


def changes(v: np.ndarray, previous: np.ndarray) -> np.ndarray:
    return np.abs(np.diff(v, axis=0, prepend=previous[None]))


def test_the_optimum_matches_ipopt() -> None:
    compared = active = 0
    for seed in range(40, 49):
        kind = ("limit", "weight", "both")[seed % 3]
        case = random_case(seed)
        if case is None:
            continue
        model, oracle, theta, rng = case
        n, half = int(rng.integers(2, 5)), model.plant.u_scale
        # One of several inputs has no rate limit.
        rates = np.where(np.arange(model.m) == 1, np.inf, rng.uniform(1.0, 5.0, model.m) * half)
        S = rng.uniform(0.0, 0.3, model.m) / half**2 if kind != "limit" else np.zeros(model.m)
        model = with_rates(model, rates if kind != "weight" else np.full(model.m, np.inf), S)
        problem = build_problem(model, oracle, n, "first_step")
        solver, reference = Solver(problem, max_iterations=300, tolerance=1e-9), ReferenceSolver(problem)
        x = rng.uniform(model.plant.x_min, model.plant.x_max)
        previous = rng.uniform(model.plant.u_min, model.plant.u_max)
        ours = solver.solve(x, theta, rng.normal(size=(n, model.m)) * 3, previous=previous)
        assert ours.status is (Status.INFEASIBLE if ours.slack else Status.CONVERGED), seed
        steps = problem.input_steps
        for inputs in (ours.v, ours.u):
            assert (changes(inputs, previous) <= steps * (1 + EXACT)).all(), seed
            assert (inputs >= model.plant.u_min).all()
            assert (inputs <= model.plant.u_max).all()
        theirs = reference.solve(x, theta, ours.c, previous=previous)
        if theirs.status is not Status.CONVERGED:
            continue
        assert ours.cost <= theirs.cost + 1e-5 * (1 + abs(theirs.cost)), seed
        np.testing.assert_allclose(ours.v, theirs.v, atol=2e-4, err_msg=str(seed))
        compared += 1
        active += bool((changes(ours.v, previous) > steps * (1 - 1e-6)).any())
    assert compared >= 6
    assert active >= 3


def test_with_a_window_the_previous_input_follows_it_in_the_state() -> None:
    """For a network with a window the present input differs from the mean input of its last pair."""
    model = with_rates(build_model(COMPRESSOR, 0.05), np.array([2.0]), np.array([0.5]))
    oracle = DnnOracle(describe(model, [6, 6], architecture="rnn", window=3))
    state = oracle.initial_state(np.random.default_rng(0))
    problem = build_problem(model, oracle, 12, "first_step")
    solver, reference = Solver(problem, max_iterations=100, tolerance=1e-9), ReferenceSolver(problem)
    s = np.concatenate([[0.1, 0.05, 0.02, 0.1], np.tile([0.1, 0.06, 0.0, 0.2, 0.3], 2)])
    for previous in (np.array([-0.3]), np.array([0.4])):
        ours = solver.solve(s, oracle.theta(state), np.zeros((12, 1)), previous=previous)
        theirs = reference.solve(s, oracle.theta(state), ours.c, previous=previous)
        assert ours.status is Status.CONVERGED
        np.testing.assert_allclose(ours.v, theirs.v, atol=2e-5)


@pytest.mark.parametrize("S", [0.0, 0.3])
def test_a_prepared_step_uses_the_input_at_its_completion(S: float) -> None:
    """The problem of the nominal model is quadratic, so one step from any start gives its solution."""
    model = with_rates(build_model(COMPRESSOR, 0.05), np.array([3.0]), np.array([S]))
    problem = build_problem(model, LinearOracle(4, 1), 20, "first_step")
    solver = Solver(problem)
    x, nothing, cold = np.array([-0.2, -0.1, 0.0, 0.5]), np.zeros(0), np.zeros((20, 1))
    for acts in ([0.1], [-0.4], [0.6]):
        exact = solver.solve(x, nothing, cold, previous=np.array(acts))
        solver.prepare(x + 0.01, nothing, cold, previous=np.array([0.1]))
        found = solver.feedback(x, previous=np.array(acts))
        assert found.status in (Status.REAL_TIME, Status.INFEASIBLE)
        np.testing.assert_allclose(found.v, exact.v, atol=1e-7)
        assert (changes(found.v, np.array(acts)) <= problem.input_steps * (1 + EXACT)).all()


def test_a_weight_is_independent_of_units_and_rate() -> None:
    """The plan in half-widths is the same, and the cost of a ramp does not depend on the sampling rate."""
    factors = np.array([10.0, 0.1, 100.0, 7.0]), np.array([1000.0])
    other = rescaled(dataclasses.replace(COMPRESSOR, u_rate_max=[4.0]), *factors)
    other = dataclasses.replace(other, u_rate_max=4.0 * factors[1])
    x, before = np.array([-0.2, -0.1, 0.0, 0.5]), np.array([0.1])
    plans = []
    for plant, unit_x, unit_u in ((COMPRESSOR, 1.0, 1.0), (other, *factors)):
        limited = dataclasses.replace(plant, u_rate_max=np.array([4.0]) * unit_u)
        unit = np.ones(4) * unit_x, np.ones(1) * unit_u
        weights = 1 / unit[0] ** 2, 1 / unit[1] ** 2
        model = build_model(limited, 0.05, *weights, S=0.02 / unit[1] ** 2)
        solver = Solver(build_problem(model, LinearOracle(4, 1), 20, "first_step"))
        plans.append(
            solver.solve(x * unit_x, np.zeros(0), np.zeros((20, 1)), previous=before * unit_u).v / unit_u
        )
    np.testing.assert_allclose(plans[0], plans[1], atol=1e-8)
    for period in (0.05, 0.005):
        step = 3.0 * period
        model = build_model(COMPRESSOR, period, S=np.array([0.5]))
        stages = round(1.0 / period)
        assert stages * step * model.S[0, 0] * step == pytest.approx(0.5 * 3.0**2)


def test_tightenings_with_a_guarantee_refuse_rate_limits() -> None:
    model = with_rates(build_model(COMPRESSOR, 0.05), np.array([3.0]), np.zeros(1))
    for tightening in ("tube", "invariant"):
        with pytest.raises(CertificateError, match="rate limits for u"):
            build_problem(model, LinearOracle(4, 1), 10, tightening)
