"""Sets of a given W, which need no equations: their claim, also with a delay, and refusals."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from lbmpc.controller.signals import Observation
from lbmpc.controller.step import Controller
from lbmpc.model import Model, ModelError, build_model
from lbmpc.plants import Known
from lbmpc.problem import build_problem
from lbmpc.sets.certificate import Certificate, CertificateError, model_of
from lbmpc.sets.check import check
from lbmpc.sets.construct import construct
from lbmpc.sets.enclosures.disturbance import DisturbanceError
from lbmpc.sets.geometry.polytope import SetError
from lbmpc.sets.motion import over_any_delay
from lbmpc.solver.gauss_newton import Solver
from tests.helpers.plants.pendulum import PENDULUM
from tests.helpers.science import oracle_named

PERIOD = 0.1
MODEL = build_model(PENDULUM.known(), PERIOD)
W = np.array([0.004, 0.05])
"""Largest h of one period."""


@pytest.fixture(scope="module")
def sets() -> Certificate:
    return construct(MODEL, "given", np.zeros(2), W=W)


def test_from_numbers_and_a_given_w_the_claim_holds(sets: Certificate) -> None:
    assert check(sets).ok
    assert sets.source_of_W == "given"
    # Their W includes the effect of the delay.
    np.testing.assert_array_equal(np.max(sets.pieces[0].W, axis=0), over_any_delay(MODEL, W))
    # Equations do not change sets of a given W.
    equations = construct(build_model(PENDULUM, PERIOD), "given", np.zeros(2), W=W)
    assert equations == sets


def test_w_covers_the_effect_of_every_delay_on_h() -> None:
    wide = over_any_delay(MODEL, W)
    assert (wide >= W).all()
    corners = np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]]) * W
    for delay in np.random.default_rng(0).uniform(0.0, 0.5 * PERIOD, 50):
        for corner in corners:
            moved = MODEL.ahead(corner, np.zeros(1), delay)
            assert (np.abs(moved) <= wide * (1 + 1e-6)).all()


@pytest.mark.parametrize("share", [0.0, 0.2, 0.5])
def test_with_a_delay_the_predicted_states_stay_inside_for_any_h(sets: Certificate, share: float) -> None:
    """h is at a corner of W in every period, and the oracle is wrong."""
    oracle = oracle_named("dnn", MODEL)
    problem = build_problem(MODEL, oracle, 6, "invariant", certificate=sets)
    delay = share * PERIOD
    controller = Controller(problem, Solver(problem), input_delay=delay)
    rng = np.random.default_rng(int(10 * share))
    for _ in range(3):
        x, before = np.zeros(2), np.zeros(1)
        state = controller.initial_state(0)
        pieces: tuple[tuple[float, np.ndarray], ...] = ((PERIOD, before),)
        for number in range(40):
            state.oracle["K"] = rng.normal(scale=1e3, size=state.oracle["K"].shape)
            seen = Observation(x, before, 1, number, None, pieces=pieces)
            state, result = controller.step(state, seen)
            assert result.first is not None
            assert result.first.piece == 0, number
            u = result.plan[0]
            pieces = ((delay, before), (PERIOD - delay, u)) if delay else ((PERIOD, u),)
            x = MODEL.A @ x + MODEL.within.answer(pieces) + W * rng.choice([-1.0, 1.0], 2)
            before = u


def test_kinds_that_need_equations_are_refused() -> None:
    for kind in ("box", "hull", "regions", "extension"):
        with pytest.raises(SetError, match=r"is given by numbers alone, .* use the kind `given`"):
            construct(MODEL, kind, np.zeros(2))
    with pytest.raises(DisturbanceError, match="give 2 half-widths"):
        construct(MODEL, "given", np.zeros(2), W=np.zeros(3))


def test_sets_of_equations_need_them_in_the_controller() -> None:
    regions = construct(build_model(PENDULUM, PERIOD), "box", np.zeros(2))
    problem = build_problem(MODEL, oracle_named("linear", MODEL), 5, "invariant", certificate=regions)
    with pytest.raises(
        ModelError, match="the prediction over the delay, which these sets require, needs the equations"
    ):
        Controller(problem, Solver(problem))


def without_motion() -> Model:
    """A model with a dead time of one period in its matrices."""
    box = {"x_min": [-1.0, -1.0], "x_max": [1.0, 1.0], "u_min": [-1.0], "u_max": [1.0]}
    known = Known.from_matrices(
        [[1.1, 0.2], [0.0, 0.0]], [[0.0], [1.0]], period=PERIOD, W=[0.01, 0.01], **box
    )
    return build_model(known, PERIOD)


def test_without_a_prediction_over_the_delay_there_are_no_sets(sets: Certificate) -> None:
    model = without_motion()
    with pytest.raises(CertificateError, match="no motion between two samples"):
        construct(model, "given", np.zeros(2))
    about_it = msgspec.structs.replace(sets, model=model_of(model))
    with pytest.raises(CertificateError, match="no motion between two samples"):
        build_problem(model, oracle_named("linear", model), 5, "invariant", certificate=about_it)
