"""Unstable plants whose predictions grow much within the horizon, and models with a bias."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller_node.build import build_model as configured_model
from lbmpc.model import ModelError, build_model, require_horizon
from lbmpc.oracles import DnnOracle, LinearOracle, Oracle
from lbmpc.plants import PLANTS, Plant
from lbmpc.problem import build_problem
from lbmpc.solver.gauss_newton import Solver
from lbmpc.solver.solution import Status
from node_runtime.config.loading import load
from node_runtime.config.strict import ConfigError
from tandem.experiments.simulation.lockstep import simulate
from tests.helpers.plants.pendulum import inverted
from tests.helpers.plants.unstable import unstable
from tests.helpers.science import compressor, describe

PERIOD = 0.05
FAST = build_model(unstable(6.0), PERIOD)
N = 60
"""The growth A^N is 7e7."""


def network(rng: np.random.Generator, size: float) -> tuple[DnnOracle, np.ndarray]:
    """Return an oracle for the fast plant with output weights of this size, and its parameters."""
    oracle = DnnOracle(describe(FAST, [8]), initial_scale=size, column_bound=100.0)
    return oracle, oracle.theta(oracle.initial_state(rng))


@pytest.fixture(scope="module")
def solver() -> Solver:
    oracle, _theta = network(np.random.default_rng(0), 1e-3)
    return Solver(build_problem(FAST, oracle, N))


@pytest.fixture(scope="module")
def nominal() -> Solver:
    return Solver(build_problem(FAST, LinearOracle(1, 1), N))


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10**6), x=st.floats(-0.8, 0.8))
def test_errors_of_h_hat_do_not_grow_over_the_horizon(
    solver: Solver, nominal: Solver, seed: int, x: float
) -> None:
    """With h_hat of a few thousandths of a half-width, the input changes by as little, although A^N is 7e7."""
    _oracle, theta = network(np.random.default_rng(seed), 1e-3)
    ours = solver.solve(np.array([x]), theta, np.zeros((N, 1)))
    theirs = nominal.solve(np.array([x]), np.zeros(0), np.zeros((N, 1)))
    assert ours.status is Status.CONVERGED
    assert ours.v[0] == pytest.approx(theirs.v[0], abs=0.05)
    assert ours.u[0] == ours.v[0]
    assert np.abs(ours.zbar).max() <= 1.0 + 1e-9


def test_a_plan_stays_near_its_trajectory_from_another_state(solver: Solver) -> None:
    _oracle, theta = network(np.random.default_rng(1), 1e-3)
    plan = solver.solve(np.array([0.3]), theta, np.zeros((N, 1)))
    # One step is enough if the start is no farther away than the state.
    once = Solver(solver.problem, max_iterations=1).solve(np.array([0.31]), theta, plan.c)
    assert once.v == pytest.approx(solver.solve(np.array([0.31]), theta, plan.c).v, abs=1e-3)


@pytest.mark.parametrize("plant", [unstable(6.0), inverted(0.3)], ids=lambda plant: plant.name)
def test_no_oracle_costs_more_than_no_oracle(plant: Plant, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(PLANTS, plant.name, plant)

    def cost(oracle: str) -> float:
        quick = ["controller.solver.compile='never'", "trainer.enabled=false", "network.hidden=[16]"]
        run = simulate(load(None, [f"plant.model={plant.name}", f"controller.oracle={oracle}", *quick]), 25)
        assert {result.status for result in run.results} == {"converged"}
        x = np.array([state.x for state in run.plant_states]) - plant.x_e
        u = np.array([command.u for command in run.commands]) - plant.u_e
        return float((x**2).sum() + (u**2).sum())

    linear = cost("linear")
    for oracle in ("constant", "l2nw", "dnn", "perfect"):
        assert cost(oracle) < 1.02 * linear, oracle


def test_a_horizon_without_accuracy_is_refused_with_the_largest_possible_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    model = build_model(unstable(10.0), PERIOD)
    require_horizon(model, 36)
    with pytest.raises(ModelError, match=r"60 steps \(3 s\).*10\^13\.0.*at most 36 steps \(1\.8 s\)"):
        require_horizon(model, 60)
    with pytest.raises(ModelError, match="37 steps"):
        build_problem(model, LinearOracle(1, 1), 37)
    with pytest.raises(ModelError, match="use a higher rate"):
        require_horizon(build_model(unstable(10.0), 2.0), 1)
    require_horizon(compressor(), 1000)
    monkeypatch.setitem(PLANTS, "runaway", unstable(10.0))
    with pytest.raises(ConfigError, match="at most 36 steps"):
        configured_model(load(None, ["plant.model=runaway"]))


@pytest.mark.parametrize("oracle", [LinearOracle(1, 1), DnnOracle(describe(FAST, [8]))], ids=lambda o: o.name)
def test_a_violated_row_is_not_reported_as_converged(oracle: Oracle) -> None:
    """The start is outside X, where no input brings the next state inside."""
    solver = Solver(build_problem(FAST, oracle, 10))
    theta = oracle.theta(oracle.initial_state(np.random.default_rng(0)))
    x, c = np.array([1.5]), np.zeros((10, 1))
    solver.prepare(x, theta, c)
    for solution in (solver.solve(x, theta, c), solver.feedback(x)):
        assert solution.status is Status.INFEASIBLE
        assert solution.slack > 0.1
        assert solution.slack_row == "x at step 10"
    assert solver.solve(0.2 * x, theta, c).status is Status.CONVERGED
