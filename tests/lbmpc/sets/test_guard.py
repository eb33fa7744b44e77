"""Bounds on the first input: inside and outside the sets, with errors and delays."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from controller_node.certified_sets import SHIPPED, read_sets
from lbmpc.model import build_model
from lbmpc.plants import get_plant
from lbmpc.sets.certificate import Certificate
from lbmpc.sets.check import check
from lbmpc.sets.construct import construct, points_in
from lbmpc.sets.geometry.operations import body
from lbmpc.sets.guard import MOST, Guard
from lbmpc.sets.invariance.approach import one_period
from tests.helpers.plants.pendulum import pendulum, two_inputs
from verification.closed_loop import Case, ClosedLoop

MODEL = pendulum()
HALF = np.array([1.0, 2.0])


@pytest.fixture(scope="module")
def compressor() -> ClosedLoop:
    certificate = read_sets(Path(SHIPPED) / "moore_greitzer-20Hz-regions.json.gz").certificate
    return ClosedLoop(certificate, build_model(get_plant("moore_greitzer"), 0.05))


def room(certificate: Certificate, index: int, x: np.ndarray, u: np.ndarray) -> float:
    """Return the distance of the next state to the nearest facet of the piece's target, for the worst w."""
    model, piece = certificate.model, certificate.pieces[index]
    target = certificate.pieces[piece.target]
    after = (np.array(model.A) + np.array(piece.slope_x)) @ x + (
        np.array(model.B) + np.array(piece.slope_u)
    ) @ u
    G = np.array(target.G)
    left = np.array(target.g) - (G @ (after + np.array(piece.W)).T).max(axis=1)
    return float((left / np.linalg.norm(G * HALF, axis=1)).min())


def states(certificate: Certificate, rng: np.random.Generator) -> np.ndarray:
    """Return some inner states and the vertices, which have the smallest distance."""
    bodies = [body(np.array(p.G), np.array(p.g), p.name, HALF) for p in certificate.pieces]
    inside = [np.vstack([points_in(b, 5, rng), b.vertices + 1e-9 * (b.centre - b.vertices)]) for b in bodies]
    return np.vstack(inside)


def test_half_of_the_checked_margin_is_kept_from_every_state(family: Certificate) -> None:
    guard, margin = Guard(family), check(family).margin
    kept = []
    for x in states(family, np.random.default_rng(1)):
        first = guard.first_inputs(x)
        assert first.piece >= 0
        assert first.lower is not None
        assert first.upper is not None
        kept += [room(family, first.piece, x, u) for u in (first.lower, first.upper)]
    assert min(kept) >= 0.5 * margin - 1e-9
    # Near the boundary the margin is the largest possible distance, so half of it is exactly kept there.
    assert min(kept) < 0.02


@pytest.mark.parametrize("most", [0.0, 0.01, MOST])
def test_the_largest_distance_is_found(family: Certificate, most: float) -> None:
    guard, rng = Guard(family), np.random.default_rng(2)
    for x in np.vstack([states(family, rng)[::7], rng.uniform(-HALF, HALF, (40, 2))]):
        index = int(np.argmax(guard.margins(x)))
        rows, piece = guard._steps[index], family.pieces[index]
        distance, u = rows.farthest(rows.room(x), most)
        grid = np.linspace(piece.u_lower[0], piece.u_upper[0], 400)
        best = max(room(family, index, x, np.array([v])) for v in grid)
        assert distance >= min(best, most) - 1e-9
        assert piece.u_lower[0] <= u[0] <= piece.u_upper[0]
        assert min(room(family, index, x, u), most) == pytest.approx(distance, abs=1e-8)


def test_outside_the_result_is_the_input_of_least_violation(family: Certificate) -> None:
    guard, rng = Guard(family), np.random.default_rng(3)
    forced = 0
    for x in rng.uniform(-HALF, HALF, (200, 2)):
        first = guard.first_inputs(x)
        if guard.margins(x).max() >= 0.0:
            continue
        assert first.piece == -1
        assert first.margin < 0.0
        assert first.lower is not None
        assert first.upper is not None
        index = int(np.argmax(guard.margins(x)))
        piece = family.pieces[index]
        grid = np.linspace(piece.u_lower[0], piece.u_upper[0], 300)
        best = max(room(family, index, x, np.array([v])) for v in grid)
        here = room(family, index, x, first.lower)
        assert here >= min(best, 0.0) - 1e-8
        if best < -1e-6:
            assert first.lower == first.upper
            forced += 1
    assert forced > 20


def test_two_inputs_outside_give_the_least_violation() -> None:
    certificate = construct(two_inputs(), "box", np.zeros(2))
    guard, rng = Guard(certificate), np.random.default_rng(4)
    piece = certificate.pieces[0]
    seen = 0
    for x in rng.uniform(0.7 * HALF, HALF, (20, 2)):
        first = guard.first_inputs(x)
        if first.piece >= 0:
            continue
        assert first.lower is not None
        tried = rng.uniform(piece.u_lower, piece.u_upper, (300, 2))
        best = max(room(certificate, 0, x, u) for u in tried)
        assert room(certificate, 0, x, first.lower) >= min(best, 0.0) - 1e-8
        seen += 1
    assert seen


@pytest.mark.parametrize("inputs", ["random", "bang-bang"])
@pytest.mark.parametrize("noise", [1e-7, 1e-6])
def test_a_wrong_oracle_stays_in_the_sets_with_measurement_errors(
    compressor: ClosedLoop, inputs: str, noise: float
) -> None:
    found = [compressor.run(Case(inputs, noise), seed, 40) for seed in range(4)]
    assert [one.outside for one in found] == [0] * 4
    assert min(one.margin for one in found) > 1e-5


@pytest.mark.parametrize("delay", [0.002, 0.01, 0.025])
def test_a_wrong_oracle_stays_in_the_sets_with_a_constant_delay(compressor: ClosedLoop, delay: float) -> None:
    found = [compressor.run(Case("bang-bang", 1e-6, delay), seed, 40) for seed in range(3)]
    assert [one.outside for one in found] == [0] * 3
    assert min(one.margin for one in found) > 1e-5
    if delay >= 0.01:
        assert sum(
            compressor.run(Case("bang-bang", 0.0, delay, known=False), s, 40).outside for s in range(3)
        )


def test_the_prediction_over_the_delay_ignores_a_wrong_oracle(compressor: ClosedLoop) -> None:
    wrong = ClosedLoop(compressor.certificate, compressor.model, "lying")
    case = Case("bang-bang", 0.0, 0.025)
    # The runs are equal, because the certificate does not depend on the oracle.
    assert wrong.run(case, 1, 40) == compressor.run(case, 1, 40)


def test_the_bounds_are_continuous_at_the_boundary(family: Certificate) -> None:
    """The bounds hardly differ between states just inside and just outside."""
    guard = Guard(family)
    base = body(np.array(family.pieces[0].G), np.array(family.pieces[0].g), "C", HALF)
    for vertex in base.vertices[::5]:
        near, beyond = (guard.first_inputs(vertex * (1 + e)) for e in (-1e-8, 1e-8))
        if near.piece != 0 or beyond.piece != -1:
            continue
        assert near.lower is not None
        assert beyond.lower is not None
        assert near.lower == pytest.approx(beyond.lower, abs=1e-3)


def test_two_inputs_are_bounded_by_a_box_that_keeps_the_sets() -> None:
    model = two_inputs()
    certificate = construct(model, "box", np.zeros(2))
    assert check(certificate).ok
    guard, rng, move = Guard(certificate), np.random.default_rng(5), one_period(model)
    base = body(np.array(certificate.pieces[0].G), np.array(certificate.pieces[0].g))
    for x in points_in(base, 30, rng):
        first = guard.first_inputs(x)
        assert first.lower is not None
        assert first.upper is not None
        for u in (first.lower, first.upper, np.array([first.lower[0], first.upper[1]])):
            assert base.contains(np.array(move(x, u)).ravel())


def test_the_bounds_on_the_first_input_equal_those_of_the_claim(family: Certificate) -> None:
    guard, rng = Guard(family, share=0.0), np.random.default_rng(6)
    bodies = [body(np.array(p.G), np.array(p.g)) for p in family.pieces]
    tight = 0
    for index, piece in enumerate(family.pieces):
        A, B = MODEL.A + np.array(piece.slope_x), MODEL.B + np.array(piece.slope_u)
        target = bodies[piece.target]
        for x in points_in(bodies[index], 20, rng):
            first = guard.first_inputs(x)
            if first.piece != index:
                # The first piece that contains x determines the bounds.
                assert first.piece < index
                assert bodies[first.piece].contains(x)
                continue
            for u, step in ((first.lower, -1e-6), (first.upper, 1e-6)):
                assert u is not None
                after = A @ x + B @ u + np.array(piece.W)
                assert target.contains(after).all()
                if piece.u_lower[0] <= u[0] + step <= piece.u_upper[0]:
                    assert not target.contains(after + B @ np.array([step])).all()
                    tight += 1
    assert tight > 10


def test_a_distance_is_kept_if_possible(family: Certificate) -> None:
    plain, wary, rng = Guard(family, share=0.0), Guard(family), np.random.default_rng(9)
    base = body(np.array(family.pieces[0].G), np.array(family.pieces[0].g), scale=np.array([1.0, 2.0]))
    tighter = 0
    for x in np.vstack([points_in(base, 60, rng), 0.97 * base.vertices]):
        all_, some = plain.first_inputs(x), wary.first_inputs(x)
        assert all_.lower is not None
        assert all_.upper is not None
        assert some.lower is not None
        assert some.upper is not None
        assert all_.lower <= some.lower <= some.upper <= all_.upper
        tighter += bool(some.upper - some.lower < all_.upper - all_.lower)
    assert tighter
