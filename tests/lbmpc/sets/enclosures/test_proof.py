"""The proof that h stays in W: it is correct, and a W that h leaves slightly is refuted with the place."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from controller_node.certified_sets import SHIPPED, read_sets
from lbmpc.model import Model, build_model
from lbmpc.plants import get_plant
from lbmpc.sets.certificate import Certificate, Piece
from lbmpc.sets.construct import construct
from lbmpc.sets.enclosures.affine_forms import Disturbance, DisturbanceError
from lbmpc.sets.enclosures.proof import _rows, prove
from lbmpc.sets.invariance.approach import one_period
from tests.helpers.plants.pendulum import pendulum, two_inputs

MODEL = pendulum()
HALF = MODEL.plant.x_scale


@pytest.fixture(scope="module")
def family() -> Certificate:
    return construct(MODEL, "regions", np.array([0.62, 0.0]))


def changed(certificate: Certificate, index: int, **parts: object) -> Certificate:
    pieces = list(certificate.pieces)
    pieces[index] = msgspec.structs.replace(pieces[index], **parts)
    return msgspec.structs.replace(certificate, pieces=pieces)


def shrunk(piece: Piece, share: float) -> list[list[float]]:
    W = np.array(piece.W)
    return (W.mean(axis=0) + share * (W - W.mean(axis=0))).tolist()


def test_constructed_hulls_and_regions_are_proved(family: Certificate) -> None:
    assert len(family.pieces) > 1
    shown: list[float] = []
    found = prove(MODEL, family, shown.append)
    assert found.reason == ""
    assert found.boxes >= len(family.pieces)
    assert found.beyond < 1e-5
    assert shown == sorted(shown)
    assert shown[-1] == pytest.approx(1.0)


@pytest.mark.parametrize("index", [0, -1])
def test_a_w_that_h_leaves_by_a_few_percent_is_refuted(family: Certificate, index: int) -> None:
    piece = family.pieces[index]
    # A piece with a slope has a W of 1 to 2 times the necessary size; a hull is accurate to one percent.
    found = prove(MODEL, changed(family, index, W=shrunk(piece, 0.97 if index == 0 else 0.4)))
    assert f"in piece {piece.name}, from x = " in found.reason
    assert "h is outside W by" in found.reason


def test_the_reported_place_is_outside(family: Certificate) -> None:
    small = changed(family, 0, W=shrunk(family.pieces[0], 0.5))
    text = prove(MODEL, small).reason
    x, u = (
        np.array([float(word) for word in text.split(f"{name} = [")[1].split("]")[0].split()])
        for name in "xu"
    )
    h = np.asarray(one_period(MODEL)(x, u)).ravel() - MODEL.step(x, u)
    W = np.array(small.pieces[0].W)
    angles = np.linspace(0, 2 * np.pi, 200)
    directions = np.column_stack([np.cos(angles), np.sin(angles)]) / HALF
    assert ((directions @ h) - (directions @ W.T).max(axis=1)).max() > 0.0


@pytest.mark.parametrize("part", ["slope_x", "slope_u"])
def test_another_slope_is_refuted(family: Certificate, part: str) -> None:
    last = len(family.pieces) - 1
    other = (np.array(getattr(family.pieces[last], part)) + 0.2).tolist()
    assert "h is outside W" in prove(MODEL, changed(family, last, **{part: other})).reason


def test_a_larger_box_than_w_was_made_for_is_refuted(family: Certificate) -> None:
    last = len(family.pieces) - 1
    wide = {"x_lower": (-HALF).tolist(), "x_upper": HALF.tolist()}
    assert "h is outside W" in prove(MODEL, changed(family, last, **wide)).reason


def test_the_budget_limits_an_undecidable_proof(family: Certificate) -> None:
    assert "not decided after 3 boxes" in prove(MODEL, family, budget=3).reason


def test_a_w_that_is_flat_off_the_axes_is_refused(family: Certificate) -> None:
    flat = [[-0.1, -0.1], [0.1, 0.1], [0.0, 0.0]]
    assert "flat in a direction that is not a state's axis" in prove(MODEL, changed(family, 0, W=flat)).reason


def test_a_w_without_width_in_a_state_is_proved_to_a_tolerance(family: Certificate) -> None:
    """A point counts as a segment of 2e-7, and the proof states how far h may be beyond W."""
    point = changed(family, 0, W=[[0.0, 0.0]])
    assert "h is outside W" in prove(MODEL, point).reason


def test_two_inputs() -> None:
    model: Model = two_inputs()
    assert prove(model, construct(model, "box", np.zeros(2))).reason == ""


def test_outside_the_domain_of_the_equations_there_is_no_proof() -> None:
    certificate = read_sets(SHIPPED / "moore_greitzer-20Hz-regions.json.gz").certificate
    model = build_model(get_plant("moore_greitzer"), 0.05)
    (low, high), last = certificate.model.X, certificate.pieces[-1]
    # The claim includes pressures below 0, at which the equations have no flow.
    wider = msgspec.structs.replace(certificate.model, X=([low[0], -3.0, *low[2:]], high))
    piece = msgspec.structs.replace(last, x_lower=[last.x_lower[0], -3.0, *last.x_lower[2:]], target=0)
    wrong = msgspec.structs.replace(certificate, model=wider, pieces=[piece])
    reason = ""
    try:
        reason = prove(model, wrong).reason
    except DisturbanceError as error:
        reason = str(error)
    assert "h is outside W" in reason or "leaves its domain of definition" in reason


def test_bounds_of_a_box_hold_at_its_points(family: Certificate) -> None:
    """h minus a steep slope is used, so that every part of the bound matters."""
    rng, disturbance, move = np.random.default_rng(1), Disturbance(MODEL), one_period(MODEL)
    rows = _rows(np.array(family.pieces[0].W), HALF)
    assert rows is not None
    slope = rng.normal(size=(2, 3))
    c = rng.uniform([-0.9, -1.8, -2.7], [0.9, 1.8, 2.7], (20, 3))
    r = rng.uniform(0.0, 0.1, (20, 3))
    forms = disturbance.forms(c - r, c + r)
    broken, slopes, room = rows.on(forms, slope)
    assert (room <= -broken).all()
    for i in range(20):
        p = c[i] + r[i] * rng.uniform(-1, 1, (200, 3))
        after = np.asarray(move(p[:, :2].T, p[:, 2:].T)).T
        rest = after - p[:, :2] @ MODEL.A.T - p[:, 2:] @ MODEL.B.T - p @ slope.T
        left = rows.b - rest @ rows.F.T
        assert (left >= room[i] - 1e-9).all()
        # By the mean-value theorem the steepest slope bounds the difference of two points.
        steepest = slopes[i].magnitude() @ r[i]
        assert (np.ptp(left, axis=0) <= 2 * steepest + 1e-9).all()


@pytest.mark.parametrize("state", [0, 1])
@pytest.mark.parametrize("end", [-1.0, 1.0])
def test_each_end_of_w_is_checked(family: Certificate, state: int, end: float) -> None:
    """h is largest at one end of X and smallest at the other; one of them is cut off here."""
    W = np.array(family.pieces[0].W)
    W[:, state] = end * np.minimum(end * W[:, state], 0.97 * (end * W[:, state]).max())
    assert "h is outside W" in prove(MODEL, changed(family, 0, W=W.tolist())).reason
