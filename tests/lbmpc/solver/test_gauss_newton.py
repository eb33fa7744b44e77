"""The solver compared with IPOPT, with wrong oracles, and with itself."""

from __future__ import annotations

import dataclasses
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lbmpc.oracles import DnnOracle, LinearOracle
from lbmpc.plants import Truth
from lbmpc.problem import build_problem, input_set
from lbmpc.solver.gauss_newton import Solver
from lbmpc.solver.solution import Status
from tests.helpers.ipopt_reference import ReferenceSolver
from tests.helpers.paths import ROOT
from tests.helpers.science import compressor, describe, oracle_named, trained_theta

MODEL = compressor()
X0 = MODEL.plant.x0 - MODEL.plant.x_e
SMALL = np.array([0.003, 0.0005, 1e-5, 1.1e-4])


@pytest.mark.parametrize("tightening", ["none", "first_step", "tube"])
@pytest.mark.parametrize("name", ["linear", "constant", "l2nw", "dnn"])
def test_the_optimum_matches_ipopt(name: str, tightening: str) -> None:
    rng = np.random.default_rng(7)
    oracle = oracle_named(name, MODEL)
    problem = build_problem(MODEL, oracle, 20, tightening, SMALL)
    solver, reference = Solver(problem, max_iterations=60, tolerance=1e-9), ReferenceSolver(problem)
    compared = active = 0
    for _ in range(16):
        x = rng.choice([-1, 1], 4) * rng.uniform([0.05, 0.05, 0.1, 1.0], [0.45, 0.45, 0.6, 8.0])
        theta = trained_theta(oracle, rng, size=0.003)
        ours = solver.solve(x, theta, rng.uniform(-1, 1, (20, 1)))
        if tightening == "tube" and ours.status is Status.INFEASIBLE:
            continue
        theirs = reference.solve(x, theta, ours.c)
        assert ours.status is (Status.INFEASIBLE if ours.slack else Status.CONVERGED)
        assert theirs.status is Status.CONVERGED
        # IPOPT stops in the interior, within its tolerance of the corner.
        assert ours.cost <= theirs.cost + 1e-5 * (1 + abs(theirs.cost))
        np.testing.assert_allclose(ours.v[0], theirs.v[0], atol=2e-6)
        compared += 1
        rows = [(zbar, set_) for zbar, set_ in zip(ours.zbar, problem.states, strict=True)]
        rows += [(v, set_) for v, set_ in zip(ours.v, problem.inputs, strict=True)]
        active += any(not set_.minus(1e-6, 1e-6).contains(set_point) for set_point, set_ in rows)
    assert compared >= 5
    assert active >= 3


def test_states_outside_every_hard_set_get_the_least_violation() -> None:
    problem = build_problem(MODEL, LinearOracle(4, 1), 20, "tube", SMALL)
    x = np.array([-0.6, -0.6, 0.0, 0.0])
    solution = Solver(problem).solve(x, np.zeros(0), np.zeros((20, 1)))
    assert solution.status is Status.INFEASIBLE
    assert solution.usable
    assert solution.slack > 0.01
    assert "at step" in solution.slack_row
    assert input_set(MODEL).contains(solution.v[0])
    # IPOPT's solution with soft constraints cannot be much better.
    soft = ReferenceSolver(dataclasses.replace(problem, soft=True)).solve(x, np.zeros(0), solution.c)
    np.testing.assert_allclose(solution.v[0], soft.v[0], atol=1e-5)


def test_the_penalty_is_exact_soft_equals_hard_where_hard_is_feasible() -> None:
    soft = build_problem(MODEL, LinearOracle(4, 1), 60, "first_step", SMALL)
    hard = dataclasses.replace(soft, soft=False)
    solve_soft, solve_hard = Solver(soft), Solver(hard)
    x, v, truth = X0, np.zeros((60, 1)), Truth(MODEL.equations)
    for _ in range(40):
        a, b = solve_soft.solve(x, np.zeros(0), v), solve_hard.solve(x, np.zeros(0), v)
        assert b.status is Status.CONVERGED
        np.testing.assert_allclose(a.v, b.v, atol=1e-7)
        assert a.slack == 0.0
        x = truth.step(x + MODEL.plant.x_e, a.v[0] + MODEL.plant.u_e, 0.05) - MODEL.plant.x_e
        v = np.vstack([a.v[1:], np.zeros((1, 1))])


LIES = st.sampled_from(["huge", "nan", "inf", "random", "steep", "alternating"])


def _lying_theta(oracle: DnnOracle, lie: str, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    theta = trained_theta(oracle, rng)
    match lie:
        case "huge":
            return theta * 1e6
        case "nan":
            theta[rng.integers(theta.size)] = np.nan
            return theta
        case "inf":
            theta[-1] = np.inf
            return theta
        case "random":
            return rng.normal(size=theta.size) * 10.0 ** rng.integers(-2, 9)
        case "steep":
            # Steep hidden layers with a large last layer: gradients of 1e6 that change sign within the horizon.
            return np.concatenate([rng.normal(size=theta.size - 36) * 300, rng.normal(size=36) * 1e3])
        case _:
            return theta * np.where(np.arange(theta.size) % 2, 1e6, -1e6)


@settings(max_examples=120, deadline=None)
@given(lie=LIES, seed=st.integers(0, 10**6), start=st.integers(0, 3))
def test_a_wrong_oracle_never_violates_a_hard_constraint(lie: str, seed: int, start: int) -> None:
    solver, oracle = _HARD
    x = np.array([[0.1, 0.1, 0, 0], [-0.1, -0.12, 0, 0], [0.3, 0.2, 0.1, 0], [0, 0, 0, 0]], dtype=float)[
        start
    ]
    warm = np.random.default_rng(seed).normal(size=(15, 1))
    solution = solver.solve(x, _lying_theta(oracle, lie, seed), warm)
    assert solution.status in (Status.CONVERGED, Status.ITERATION_LIMIT, Status.ORACLE_REFUSED)
    for i, (states, inputs) in enumerate(zip(solver.problem.states, solver.problem.inputs, strict=True)):
        assert states.contains(solution.zbar[i], 1e-6)
        assert inputs.contains(solution.v[i])
    nominal = x
    for i in range(15):
        nominal = MODEL.A @ nominal + MODEL.B @ solution.v[i]
        np.testing.assert_allclose(nominal, solution.zbar[i], atol=1e-9)


def _hard_problem() -> tuple[Solver, DnnOracle]:
    oracle = DnnOracle(describe(MODEL, [8, 8]))
    return Solver(build_problem(MODEL, oracle, 15, "tube", SMALL)), oracle


_HARD = _hard_problem()


@pytest.mark.parametrize("x", [np.full(4, np.nan), np.full(4, 1e200), np.array([np.inf, 0, 0, 0])])
def test_an_unusable_state_gives_a_status_and_no_exception(x: np.ndarray) -> None:
    solver, oracle = _HARD
    solution = solver.solve(x, _lying_theta(oracle, "random", 0), np.zeros((15, 1)))
    assert solution.status in (Status.NUMERICAL, Status.INFEASIBLE)


def test_a_garbage_warm_start_changes_nothing() -> None:
    oracle = oracle_named("dnn", MODEL)
    solver = Solver(build_problem(MODEL, oracle, 20, "first_step", SMALL), max_iterations=30, tolerance=1e-10)
    theta = trained_theta(oracle, np.random.default_rng(0), size=0.003)
    clean = solver.solve(X0, theta, np.zeros((20, 1)))
    for garbage in (np.full((20, 1), np.nan), np.full((20, 1), 1e9), -np.ones((20, 1))):
        np.testing.assert_allclose(solver.solve(X0, theta, garbage).v, clean.v, atol=1e-8)


def test_one_iteration_is_feasible() -> None:
    oracle = DnnOracle(describe(MODEL, [8, 8]))
    solver = Solver(build_problem(MODEL, oracle, 15, "tube", SMALL), max_iterations=1)
    theta = trained_theta(oracle, np.random.default_rng(0))
    solution = solver.solve(np.array([0.3, 0.2, 0.1, 0.0]), theta, np.ones((15, 1)))
    assert solution.status is Status.ITERATION_LIMIT
    for i, states in enumerate(solver.problem.states):
        assert states.contains(solution.zbar[i], 1e-7)


def test_a_reference_is_followed() -> None:
    solver = Solver(build_problem(MODEL, LinearOracle(4, 1), 40, "none", SMALL))
    # A steady state of the nominal model away from the equilibrium.
    target_u = np.array([0.02])
    target_x = np.linalg.solve(np.eye(4) - MODEL.A, MODEL.B @ target_u)
    solution = solver.solve(
        target_x, np.zeros(0), np.zeros((40, 1)), np.tile(target_x, (41, 1)), np.tile(target_u, (40, 1))
    )
    np.testing.assert_allclose(solution.v[0], target_u, atol=1e-9)
    assert solution.cost == pytest.approx(0.0, abs=1e-12)


SCRIPT = """
import sys; sys.path.insert(0, {root!r})
from tests.lbmpc.solver.test_gauss_newton import X0, MODEL, SMALL
from tests.helpers.science import oracle_named, trained_theta
from lbmpc.problem import build_problem
from lbmpc.solver.gauss_newton import Solver
import numpy as np, hashlib
oracle = oracle_named("dnn", MODEL)
solver = Solver(build_problem(MODEL, oracle, 20, "first_step", SMALL))
theta = trained_theta(oracle, np.random.default_rng(0), size=0.003)
for _ in range({solves}):
    solution = solver.solve(X0, theta, np.zeros((20, 1)))
print(hashlib.sha256(solution.v.tobytes() + solution.zbar.tobytes()).hexdigest())
"""


@pytest.mark.long
def test_fresh_and_reused_processes_give_the_same_bytes() -> None:
    answers = {
        subprocess.run(
            [sys.executable, "-c", SCRIPT.format(root=str(ROOT), solves=solves)],
            check=True,
            capture_output=True,
            text=True,
        ).stdout
        for solves in (1, 1, 5)
    }
    assert len(answers) == 1
