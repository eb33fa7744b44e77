"""Targets: rests of the learned model inside X and U nearest to the reference, for any numbers."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
from scipy.optimize import minimize

from lbmpc.model import Model
from lbmpc.oracles import ConstantOracle, DnnOracle, LinearOracle, Oracle, PerfectOracle
from lbmpc.oracles.base import remembered
from lbmpc.problem import build_problem
from lbmpc.targets import REACHED, SteadyState, TargetSelector
from tests.helpers.science import compressor, describe, function, oracle_named, trained_theta

MODEL = compressor()
PLANT = MODEL.plant
SCALE = np.concatenate([PLANT.x_scale, PLANT.u_scale])
NOWHERE = np.zeros(5)
Y = 1


Find = Callable[[np.ndarray, np.ndarray], SteadyState]


def selector(
    oracle: Oracle, outputs: tuple[int, ...] = (Y,), r: tuple[float, ...] = (0.0,), model: Model = MODEL
) -> Find:
    selects = TargetSelector(build_problem(model, oracle, 10))
    return partial(selects.find, outputs=outputs, r=np.array(r))


def found(finder: Find, theta: np.ndarray, searches: int = 3) -> SteadyState:
    """Return the target after several searches, as in successive ticks."""
    target = finder(theta, NOWHERE)
    for _ in range(searches - 1):
        target = finder(theta, target.xu)
    return target


def motion(oracle: Oracle, theta: np.ndarray, xu: np.ndarray) -> np.ndarray:
    """Return the motion of the learned model from x under u in one period, in half-widths, after a rest at x."""
    x, u = xu[:4], xu[4:]
    s = np.concatenate([x, np.tile(xu, oracle.pairs - 1)])
    assert len(s) == 4 + remembered(oracle)
    h, _slopes = function(oracle)(s, u, theta)
    return (MODEL.step(x, u) - x + np.array(h)[:, 0]) / PLANT.x_scale


def is_inside(oracle: Oracle, xu: np.ndarray) -> bool:
    """Return whether it is in X, tightened as for the first step, and in U."""
    problem = build_problem(MODEL, oracle, 10)
    return problem.states[0].contains(xu[:4], 1e-7) and problem.inputs[0].contains(xu[4:], 1e-7)


def network(architecture: str) -> DnnOracle:
    return DnnOracle(describe(MODEL, [8, 8], architecture=architecture))


ORACLES = {
    **{name: oracle_named(name, MODEL) for name in ("linear", "constant", "l2nw", "dnn")},
    "rnn": network("rnn"),
    "perfect": PerfectOracle(MODEL),
}


def theta_of(oracle: Oracle, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    if isinstance(oracle, PerfectOracle):
        return np.array([1.0, 0.0, rng.uniform(1.35, 1.65)])
    # Labels of the size of a model error, a percent of a half-width.
    return trained_theta(oracle, rng, size=0.002)


@pytest.mark.parametrize("name", ORACLES)
@pytest.mark.parametrize(("outputs", "r"), [((Y,), (0.05,)), ((), ()), ((0,), (-0.1,)), ((0, 1), (0.0, 0.0))])
def test_a_target_is_a_rest_of_the_learned_model_inside_its_bounds(
    name: str, outputs: tuple[int, ...], r: tuple[float, ...]
) -> None:
    oracle = ORACLES[name]
    finder, reached = selector(oracle, outputs, r), 0
    for seed in range(5):
        theta = theta_of(oracle, seed)
        target = found(finder, theta)
        if target.status == "no rest":
            continue
        reached += target.status == "reached"
        assert np.abs(motion(oracle, theta, target.xu)).max() < 1e-8
        assert is_inside(oracle, target.xu)
        off = np.abs(target.xu[list(outputs)] - r) / PLANT.x_scale[list(outputs)]
        assert target.distance == pytest.approx(off.max(initial=0.0), abs=1e-12)
        assert (target.status == "reached") == (target.distance < REACHED)
    # One input cannot bring two outputs to arbitrary values.
    assert reached == 0 if len(outputs) > 1 and name != "linear" else reached >= 3


def by_another_method(oracle: Oracle, theta: np.ndarray, cost: Any) -> np.ndarray:
    """Return the minimum of a cost over the rests inside X and U, (d + m,), by scipy's SLSQP."""
    problem = build_problem(MODEL, oracle, 10)
    bounds = [*zip(problem.states[0].lower, problem.states[0].upper, strict=True)]
    bounds += [*zip(problem.inputs[0].lower, problem.inputs[0].upper, strict=True)]
    rests: dict[str, Any] = {"type": "eq", "fun": lambda w: 100 * motion(oracle, theta, w * SCALE)}
    inside = [(low / half, high / half) for (low, high), half in zip(bounds, SCALE, strict=True)]
    options = {"ftol": 1e-13, "maxiter": 100}
    done = minimize(
        lambda w: cost(w * SCALE),
        np.zeros(5),
        bounds=inside,
        constraints=rests,
        method="SLSQP",
        options=options,
    )
    # SLSQP reports no success if it cannot improve the start.
    assert np.abs(rests["fun"](done.x)).max() < 1e-6
    return done.x * SCALE


@pytest.mark.parametrize("name", ["constant", "dnn", "rnn", "perfect"])
@pytest.mark.parametrize("seed", [0, 1])
def test_without_outputs_the_target_is_the_rest_of_least_cost(name: str, seed: int) -> None:
    oracle = ORACLES[name]
    theta = theta_of(oracle, seed)
    target = found(selector(oracle, (), ()), theta)
    other = by_another_method(
        oracle, theta, lambda w: 100 * (w[:4] @ MODEL.Q @ w[:4] + w[4:] @ MODEL.R @ w[4:])
    )
    assert target.status == "reached"
    np.testing.assert_allclose(target.xu / SCALE, other / SCALE, atol=2e-5)


@pytest.mark.parametrize("name", ["linear", "constant", "dnn"])
@pytest.mark.parametrize("y", [0.4999, -0.4999, 3.0])
def test_an_unreachable_reference_gives_the_nearest_rest_and_its_distance(name: str, y: float) -> None:
    """X less W limits y at one end, and the throttle limits it at the other."""
    oracle = ORACLES[name]
    theta = theta_of(oracle, 0)
    target = found(selector(oracle, (Y,), (y,)), theta)
    other = by_another_method(oracle, theta, lambda w: -np.sign(y) * w[Y])
    assert target.status == "nearest"
    assert is_inside(oracle, target.xu)
    assert target.xu[Y] == pytest.approx(other[Y], abs=1e-5)
    assert target.distance == pytest.approx(abs(target.xu[Y] - y) / PLANT.x_scale[Y], rel=1e-9)
    assert target.distance > REACHED


@pytest.mark.parametrize("number", [np.nan, np.inf, -np.inf, 1e300, -1e160])
@pytest.mark.parametrize("name", ["constant", "l2nw", "dnn"])
@pytest.mark.parametrize("outputs", [(Y,), ()])
def test_unusable_numbers_give_the_equilibrium(name: str, number: float, outputs: tuple[int, ...]) -> None:
    oracle = ORACLES[name]
    finder, good = selector(oracle, outputs, (0.05,) * len(outputs)), theta_of(oracle, 0)
    before = found(finder, good)
    wild = finder(np.full_like(good, number), before.xu)
    assert np.isfinite(wild.xu).all()
    assert (np.abs(wild.xu) <= SCALE * 1.5).all()
    if not np.isfinite(number):
        assert wild.status == "no rest"
        np.testing.assert_array_equal(wild.xu, NOWHERE)
    again = finder(good, wild.xu)
    again = finder(good, again.xu)
    np.testing.assert_allclose(again.xu, before.xu, atol=1e-7)


def test_without_a_rest_inside_the_status_says_so_and_the_target_stays_inside() -> None:
    finder = selector(ConstantOracle(4, 1, 0.5))
    target = found(finder, np.array([0.2, 0.2, 0.0, 0.0]))
    assert target.status == "no rest"
    assert (target.xu >= np.concatenate([PLANT.x_min - PLANT.x_e, PLANT.u_min - PLANT.u_e]) - 1e-12).all()
    assert (target.xu <= np.concatenate([PLANT.x_max - PLANT.x_e, PLANT.u_max - PLANT.u_e]) + 1e-12).all()


def test_the_same_numbers_give_the_same_bits() -> None:
    oracle = ORACLES["dnn"]
    finders = [selector(oracle, (Y,), (y,)) for y in (0.05, 0.05)]
    theta = theta_of(oracle, 2)
    finders[0](theta_of(oracle, 1), NOWHERE)
    assert finders[0](theta, NOWHERE).xu.tobytes() == finders[1](theta, NOWHERE).xu.tobytes()


def test_a_model_without_h_rests_at_the_equilibrium() -> None:
    for outputs, r in (((), ()), ((Y,), (0.0,))):
        target = found(selector(LinearOracle(4, 1), outputs, r), np.zeros(0))
        assert (target.status, target.distance) == ("reached", 0.0)
        np.testing.assert_allclose(target.xu, 0.0, atol=1e-12)


def test_a_selector_can_be_reused_for_other_references() -> None:
    """The result is bit for bit that of a new selector, so nothing remains of the last reference."""
    oracle = ORACLES["dnn"]
    theta, selects = theta_of(oracle, 2), TargetSelector(build_problem(MODEL, oracle, 10))
    for outputs, r in (((Y,), (0.05,)), ((0,), (-0.1,)), ((), ()), ((0, Y), (0.0, 0.1)), ((Y,), (0.05,))):
        target = selects.find(theta, NOWHERE, outputs, np.array(r))
        assert target.xu.tobytes() == selector(oracle, outputs, r)(theta, NOWHERE).xu.tobytes()
        assert (target.outputs, target.r.tolist()) == (outputs, list(r))
