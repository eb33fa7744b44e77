"""Rows besides the boxes: inputs in U, and states that are relaxed in order; compared with IPOPT."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from lbmpc.controller.fallback import all_reachable, feedback_plan
from lbmpc.model import Model, build_model
from lbmpc.oracles import LinearOracle
from lbmpc.plants import Known, get_plant
from lbmpc.problem import build_problem
from lbmpc.sets.certificate import CertificateError
from lbmpc.sets.motion import require_certifiable
from lbmpc.solver.gauss_newton import Solver
from lbmpc.solver.least_distance import Penalty, least_distance, violation
from lbmpc.solver.priorities import contradicts, in_order
from lbmpc.solver.solution import Status
from lbmpc.targets import TargetSelector
from tests.helpers.ipopt_reference import ReferenceSolver
from tests.lbmpc.solver.test_other_plants import random_case

NOTHING = np.zeros(0)
CART = Known.from_matrices(
    [[0.0, 1.0], [0.0, 0.0]],
    [[0.0, 0.0], [1.0, 1.0]],
    W=[0.0, 0.0],
    states=("p", "v"),
    inputs=("a", "b"),
    x_min=[-2.0, -2.0],
    x_max=[2.0, 2.0],
    u_min=[-1.0, -1.0],
    u_max=[1.0, 1.0],
)
SHARED = {"supply": {"a": 1.0, "b": 1.0, "min": -1.2, "max": 0.8}}


def with_rows(model: Model, rows: dict[str, Any], **others: Any) -> Model:
    return replace(model, plant=replace(model.plant, rows=rows, **others))


def solved(model: Model, x: np.ndarray, n: int = 12) -> np.ndarray:
    """Return the nominal states of the optimum, (n, d)."""
    problem = build_problem(model, LinearOracle(model.d, model.m), n, "none")
    return Solver(problem).solve(x, NOTHING, np.zeros((n, model.m))).zbar


def test_the_optimum_matches_ipopt() -> None:
    compared = of_states = of_inputs = 0
    for seed in range(60, 68):
        case = random_case(seed)
        if case is None:
            continue
        model, oracle, theta, rng = case
        plant, n = model.plant, int(rng.integers(2, 5))
        rows: dict[str, Any] = {}
        direction = rng.normal(size=model.d) / plant.x_scale
        room = 0.3 * np.abs(direction * plant.x_scale).sum()
        rows["slope"] = dict(zip(plant.states, direction.tolist(), strict=True))
        rows["slope"] |= {
            "min": float(direction @ plant.x_e - room),
            "max": float(direction @ plant.x_e + room),
        }
        direction = rng.normal(size=model.m) / plant.u_scale
        room = 0.2 * np.abs(direction * plant.u_scale).sum()
        rows["supply"] = dict(zip(plant.inputs, direction.tolist(), strict=True))
        rows["supply"] |= {"max": float(direction @ plant.u_e + room)}
        rates = rng.uniform(3.0, 9.0, model.m) * plant.u_scale if seed % 2 else None
        model = with_rows(model, rows, u_rate_max=rates)
        problem = build_problem(model, oracle, n, "first_step")
        solver, reference = Solver(problem, max_iterations=300, tolerance=1e-9), ReferenceSolver(problem)
        x = rng.uniform(plant.x_min, plant.x_max) - plant.x_e
        ours = solver.solve(x, theta, rng.normal(size=(n, model.m)))
        theirs = reference.solve(x, theta, ours.c)
        beside = model.plant.input_rows
        for inputs in (ours.v, ours.u):
            assert (beside.beyond(inputs + plant.u_e) <= 1e-15).all(), seed
        if theirs.status is not Status.CONVERGED:
            continue
        assert ours.cost <= theirs.cost + 1e-5 * (1 + abs(theirs.cost)), seed
        np.testing.assert_allclose(ours.v, theirs.v, atol=2e-4, err_msg=str(seed))
        compared += 1
        states = model.plant.state_rows
        of_states += bool((states.beyond(ours.zbar + plant.x_e) > -1e-6).any())
        of_inputs += bool((beside.beyond(ours.v + plant.u_e) > -1e-6).any())
    assert compared >= 5
    assert of_states >= 2
    assert of_inputs >= 2


def test_less_important_rows_do_not_affect_important_ones() -> None:
    """With random rows of three priorities, the violation of each equals that without less important rows."""
    rng, contradicted, kept = np.random.default_rng(0), 0, 0
    for _ in range(60):
        y, M = rng.normal(size=9), rng.normal(size=(9, 3)) * 10.0 ** rng.uniform(-1.0, 1.0, (9, 1))
        levels, upper = np.repeat([-1, 0, 1, 2], [1, 2, 3, 3]), rng.uniform(-0.3, 0.3, 9)
        lower, upper = np.where(rng.random(9) < 0.3, upper - 0.5, -np.inf), upper
        # The hard rows are feasible.
        lower[0], upper[0] = y[0] - 0.1, y[0] + 0.2
        penalty = Penalty(levels >= 0, np.abs(M).sum(axis=1), 1e3)

        def outside(levels_shown: int, rows=(y, M, lower, upper, penalty, levels)) -> np.ndarray:
            y, M, lower, upper, penalty, levels = rows
            shown = levels <= levels_shown
            few = replace(penalty, soft=penalty.soft[shown], scale=penalty.scale[shown])
            found = in_order(y[shown], M[shown], lower[shown], upper[shown], few, levels[shown])
            assert found is not None
            return violation(found[0].values, lower[shown], upper[shown]) / few.scale

        alone, two, three = outside(0), outside(1), outside(2)
        assert (two[:3] <= alone + 1e-7).all()
        assert (three[:6] <= two + 1e-7).all()
        assert three[0] < 1e-8
        plain = least_distance(y, M, lower, upper, penalty)
        assert plain is not None
        if contradicts(plain.values, lower, upper, penalty.scale, levels):
            contradicted += 1
            kept += bool(alone.max() < 1e-7 and violation(plain.values, lower, upper)[1:3].max() > 1e-3)
        else:
            np.testing.assert_allclose(
                plain.values, y + M @ in_order(y, M, lower, upper, penalty, levels)[0].w, atol=1e-5
            )
    assert contradicted >= 20
    assert kept >= 3


@pytest.mark.parametrize("important", ["near", "far"])
def test_only_the_priority_decides_which_row_is_violated(important: str) -> None:
    """p at most 0 conflicts with p at least 0.5; the more important row is satisfied to the tolerance."""
    plain = {"near": {"p": 1.0, "max": 0.1}, "far": {"p": 1.0, "min": -0.05, "max": 0.9}}
    # About another rest the two rows conflict.
    far = {"p": -1.0, "v": -0.2, "max": 0.05}
    rows = {"near": {**plain["near"], "v": 1.0}, "far": far}
    for name, row in rows.items():
        row["priority"] = 1 if name == important else 2
    model = with_rows(build_model(CART, 0.2), rows)
    problem = build_problem(model, LinearOracle(2, 2), 10, "none")
    solver = Solver(problem)
    x = np.array([-1.0, 1.4])
    found = solver.solve(x, NOTHING, np.zeros((10, 2)))
    outside = model.plant.state_rows.beyond(found.zbar).clip(0.0)
    first = model.plant.state_rows.names.index(important)
    alone = with_rows(model, {important: rows[important]})
    wanted = alone.plant.state_rows.beyond(solved(alone, x, 10)).clip(0.0)[:, 0]
    np.testing.assert_allclose(outside[:, first], wanted, atol=1e-6)
    assert outside[:, 1 - first].sum() > 1e-2
    assert found.status is Status.INFEASIBLE
    assert found.slack_row.split()[0] in rows
    # A prepared step gives the same result, because the problem is quadratic.
    solver.prepare(x + 0.01, NOTHING, found.c)
    again = solver.feedback(x)
    np.testing.assert_allclose(again.v, found.v, atol=1e-6)


@pytest.mark.parametrize("rates", [None, [1.0, 4.0]])
def test_inputs_stay_in_U(rates: list[float] | None) -> None:
    model = with_rows(build_model(CART, 0.2), SHARED, u_rate_max=None if rates is None else np.array(rates))
    plant = model.plant
    steps = plant.input_rates * model.period
    problem = build_problem(model, LinearOracle(2, 2), 8, "first_step")
    solver, rng, acts, touched = Solver(problem), np.random.default_rng(1), np.array([0.5, 0.3]), 0
    for x in rng.uniform(-3.0, 3.0, (15, 2)):
        found = solver.solve(x, NOTHING, rng.normal(size=(8, 2)), previous=acts)
        plans = [found.v, found.u, feedback_plan(model, x, 8, previous=None if rates is None else acts)]
        if rates is not None:
            plans.append(
                all_reachable(model, np.array([plant.within(u) for u in rng.normal(size=(8, 2))]), acts)
            )
        for plan in plans:
            assert (plant.input_rows.beyond(plan) <= 1e-15).all()
            assert (np.abs(plan) <= 1.0).all()
            if rates is not None:
                assert (np.abs(np.diff(plan, axis=0, prepend=acts[None])) <= steps * (1 + 1e-9)).all()
        touched += bool((plant.input_rows.beyond(found.v) > -1e-6).any())
    assert touched >= 5


def test_an_input_does_not_get_stuck_at_a_row() -> None:
    """The inputs move from one end of a shared supply to the other. Clipped one by one, they would not move at all."""
    model = with_rows(build_model(CART, 0.2), SHARED, u_rate_max=np.array([0.5, 5.0]))
    start, end = np.array([0.8, 0.0]), np.array([-0.2, 1.0])
    there = all_reachable(model, np.tile(end, (12, 1)), start)
    assert (model.plant.input_rows.beyond(there) <= 1e-12).all()
    np.testing.assert_allclose(there[-1], end, atol=1e-9)
    assert not np.allclose(there[8], end, atol=1e-3)


def test_a_violated_row_without_inputs_only_adds_slack() -> None:
    """In discrete time an input first changes the velocity, so the position of the next step is fixed."""
    limits = {"x_min": [-1, -1], "x_max": [1, 1], "u_min": [-1], "u_max": [1]}
    cart = Known.from_matrices([[1, 0.1], [0, 1]], [[0.0], [0.1]], period=0.1, W=[0, 0], **limits)
    for rows in ({}, {"left": {"x1": 1.0, "max": 0.5, "priority": 2}}):
        model = build_model(replace(cart, rows=rows), 0.1)
        problem = build_problem(model, LinearOracle(2, 1), 10, "none")
        found = Solver(problem).solve(np.array([1.2, 0.1]), NOTHING, np.zeros((10, 1)))
        assert found.status is Status.INFEASIBLE
        np.testing.assert_allclose(found.v[:3], -1.0)


def test_targets_are_inside_the_rows() -> None:
    model = with_rows(build_model(CART, 0.2), {"left": {"p": 1.0, "v": 0.1, "max": 0.7}})
    selector = TargetSelector(build_problem(model, LinearOracle(2, 2), 5, "none"))
    found = selector.find(NOTHING, np.zeros(4), (0,), np.array([1.5]))
    assert found.status == "nearest"
    assert found.xu[0] == pytest.approx(0.7, abs=1e-5)


def test_options_that_need_boxes_refuse_rows_by_name() -> None:
    model = with_rows(build_model(CART, 0.2), SHARED)
    with pytest.raises(CertificateError, match="supply"):
        build_problem(model, LinearOracle(2, 2), 5, "tube")
    with pytest.raises(CertificateError, match="supply"):
        require_certifiable(model)
    # The tube supports rows of states.
    model = with_rows(build_model(CART, 0.2), {"left": {"p": 1.0, "v": 0.1, "max": 0.7}})
    assert "left" in build_problem(model, LinearOracle(2, 2), 5, "tube").states[0].names


def test_a_state_row_tightens_with_W() -> None:
    compressor = get_plant("moore_greitzer").changed({}, rows={"surge": {"z": 1.0, "y": -0.5, "max": 0.3}})
    model = build_model(compressor, 0.05)
    first, second = build_problem(model, LinearOracle(4, 1), 2, "first_step").states
    w = model.plant.W * model.period
    assert second.upper[4] - first.upper[4] == pytest.approx(w[0] + 0.5 * w[1])
