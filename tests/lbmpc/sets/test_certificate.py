"""What is claimed of sets, who checks it, and what the controller does with it."""

from __future__ import annotations

import re
from dataclasses import replace

import msgspec
import numpy as np
import pytest

from lbmpc.controller.signals import Observation
from lbmpc.controller.step import Controller
from lbmpc.model import build_model
from lbmpc.oracles import DnnOracle
from lbmpc.plants import get_plant
from lbmpc.problem import build_problem
from lbmpc.sets import check as checker
from lbmpc.sets.certificate import Certificate, CertificateError, Piece, decode, encode, require_match
from lbmpc.sets.check import check
from lbmpc.sets.constraint_sets import state_set
from lbmpc.sets.construct import construct, points_in, volume_fraction
from lbmpc.sets.geometry.operations import body
from lbmpc.sets.guard import Guard
from lbmpc.sets.invariance.approach import one_period
from lbmpc.solver.constraint_rows import Box
from lbmpc.solver.gauss_newton import Solver
from lbmpc.solver.solution import Solution, Status
from tests.helpers.plants.pendulum import pendulum, two_inputs
from tests.helpers.science import oracle_named

MODEL = pendulum()
START = np.array([0.62, 0.0])


@pytest.fixture(scope="module")
def family() -> Certificate:
    """A base set and a chain of pieces from a state outside of it."""
    found = construct(MODEL, "regions", START)
    assert len(found.pieces) > 3
    return found


def changed(certificate: Certificate, index: int, **fields: object) -> Certificate:
    pieces = list(certificate.pieces)
    pieces[index] = msgspec.structs.replace(pieces[index], **fields)
    return msgspec.structs.replace(certificate, pieces=pieces)


def moved_out(piece: Piece, row: int, by: float) -> list[float]:
    half = np.array([1.0, 2.0])
    return [
        g + by * np.linalg.norm(np.array(piece.G[row]) * half) * (i == row) for i, g in enumerate(piece.g)
    ]


def test_the_claim_holds_and_more_is_known_with_more_knowledge_of_h(family: Certificate) -> None:
    box, hull = (construct(MODEL, kind, START) for kind in ("box", "hull"))
    verdicts = [check(c) for c in (box, hull, family)]
    assert all(v.ok and v.margin > 0 for v in verdicts)
    fractions = [volume_fraction(c) for c in (box, hull, family)]
    # For this plant the hull of h is nearly its box.
    assert fractions[0] * (1 - 1e-5) <= fractions[1] < fractions[2]
    assert Guard(hull).first_inputs(START).piece == -1
    assert Guard(family).first_inputs(START).piece > 0


def test_every_facet_moved_outwards_by_a_thousandth_is_refused(family: Certificate) -> None:
    for row in range(len(family.pieces[0].g)):
        verdict = check(changed(family, 0, g=moved_out(family.pieces[0], row, 1e-3)))
        assert not verdict.ok
        assert "piece 0 (C)" in verdict.reason


@pytest.mark.parametrize(
    ("index", "fields", "says"),
    [
        (0, {"W": [[0.01, 0.1], [-0.01, 0.1], [0.01, -0.1], [-0.01, -0.1]]}, "no input found"),
        (0, {"slope_x": [[0.0, 0.0], [0.05, 0.0]]}, "no input found"),
        (1, {"target": 5}, "no input found"),
        (1, {"u_lower": [2.9], "u_upper": [3.0]}, "no input found"),
        (1, {"u_upper": [3.1]}, "outside U"),
        (1, {"x_upper": [0.2, 2.0]}, "the box where its W holds"),
        (
            0,
            {"G": [[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0]], "g": [1.0, 1.0, 1.0]},
            "flat or unbounded|rows that should meet",
        ),
    ],
)
def test_a_false_claim_is_refused(family: Certificate, index: int, fields: dict, says: str) -> None:
    verdict = check(changed(family, index, **fields))
    assert not verdict.ok
    assert re.search(says, verdict.reason), verdict.reason


def test_the_checker_knows_when_vertices_are_missing(
    monkeypatch: pytest.MonkeyPatch, family: Certificate
) -> None:
    complete = checker._bases
    monkeypatch.setattr(checker, "_bases", lambda *a: complete(*a)[1:])
    verdict = check(family)
    assert not verdict.ok
    assert "edges lead to no vertex" in verdict.reason


def test_a_certificate_comes_back_bit_for_bit_and_fits_one_model_only(family: Certificate) -> None:
    again = decode(encode(family))
    assert again == family
    assert again.sha256 == family.sha256
    require_match(again, MODEL)
    with pytest.raises(
        CertificateError, match=r"period: sha256 \w{12} there, \w{12} here.*tandem sets compute"
    ):
        require_match(again, pendulum(0.11))
    compressor = build_model(get_plant("moore_greitzer"), 0.1)
    with pytest.raises(CertificateError, match="plant: sha256"):
        require_match(again, compressor)


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (b"", "not a certificate"),
        (b"{}", "not a certificate"),
        (b'{"format": 1}', "not a certificate"),
        (b"\xff\x00", "not a certificate"),
    ],
)
def test_garbage_is_no_certificate(data: bytes, says: str) -> None:
    with pytest.raises(CertificateError, match=says):
        decode(data)


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        ({"g": [1.0]}, "G has shape"),
        ({"target": 99}, "target that is not there"),
        ({"slope_u": [[0.0, 0.0], [0.0, 0.0]]}, "slope_u has shape"),
        ({"W": [[0.0], [0.0, 1.0]]}, "different lengths"),
    ],
)
def test_a_certificate_of_the_wrong_shape_is_no_certificate(
    family: Certificate, fields: dict, says: str
) -> None:
    with pytest.raises(CertificateError, match=says):
        decode(encode(changed(family, 0, **fields)))


def test_work_that_was_done_is_not_done_again(family: Certificate) -> None:
    class Interrupted(Exception):
        pass

    saved: dict[str, dict[str, np.ndarray]] = {}
    said: list[str] = []

    def interrupt(what: str, _done: float) -> None:
        said.append(what)
        if what.startswith("the invariant set: step 12"):
            raise Interrupted

    with pytest.raises(Interrupted):
        construct(MODEL, "regions", START, saved=saved, report=interrupt)
    said.clear()
    again = construct(MODEL, "regions", START, saved=saved, report=lambda what, _done: said.append(what))
    assert not any("W as" in what for what in said)
    assert "step 11," in said[0]
    assert encode(again) == encode(family)


def observation(x: np.ndarray, number: int) -> Observation:
    return Observation(x, None, 1, number, None)


@pytest.mark.parametrize("real_time", [False, True])
@pytest.mark.parametrize("theory", ["none", "lies", "nan"])
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


def test_outside_it_says_so_and_finds_back(family: Certificate) -> None:
    problem = build_problem(MODEL, oracle_named("linear", MODEL), 10, "invariant", certificate=family)
    controller = Controller(problem, Solver(problem))
    move = one_period(MODEL)
    # Outside of every piece, and still to be saved.
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


def test_the_approximation_of_the_paper_claims_nothing_and_would_not_hold(family: Certificate) -> None:
    approximation = construct(MODEL, "extension", START)
    assert volume_fraction(approximation) > volume_fraction(family)
    verdict = check(approximation)
    assert not verdict.ok
    assert "claims nothing" in verdict.reason
    assert "no input found" in check(msgspec.structs.replace(approximation, certified=True)).reason
    with pytest.raises(CertificateError, match="claims nothing"):
        build_problem(MODEL, oracle_named("linear", MODEL), 5, "invariant", certificate=approximation)


def test_without_sets_there_is_no_invariant_tightening() -> None:
    with pytest.raises(CertificateError, match="tandem sets compute"):
        build_problem(MODEL, oracle_named("linear", MODEL), 5, "invariant")


def test_two_inputs_are_kept_in_a_box_that_keeps_the_sets() -> None:
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


def test_the_bounds_on_the_first_input_are_those_of_the_claim_and_no_tighter(family: Certificate) -> None:
    guard, rng = Guard(family, share=0.0), np.random.default_rng(6)
    bodies = [body(np.array(p.G), np.array(p.g)) for p in family.pieces]
    tight = 0
    for index, piece in enumerate(family.pieces):
        A, B = MODEL.A + np.array(piece.slope_x), MODEL.B + np.array(piece.slope_u)
        target = bodies[piece.target]
        for x in points_in(bodies[index], 20, rng):
            first = guard.first_inputs(x)
            if first.piece != index:
                # The first piece that holds x decides.
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


def test_a_distance_is_kept_where_it_can_be_had(family: Certificate) -> None:
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


def test_a_last_digit_is_no_other_model(family: Certificate) -> None:
    again = msgspec.structs.replace(family.model, A=(np.array(family.model.A) * (1 + 3e-16)).tolist())
    require_match(msgspec.structs.replace(family, model=again), MODEL)
    other = msgspec.structs.replace(family.model, A=(np.array(family.model.A) * (1 + 1e-9)).tolist())
    with pytest.raises(CertificateError, match="A: sha256"):
        require_match(msgspec.structs.replace(family, model=other), MODEL)


@pytest.mark.parametrize("wish", [-50.0, 50.0])
def test_whatever_the_cost_wants_the_first_input_stays_within_its_bounds(wish: float) -> None:
    problem = build_problem(MODEL, oracle_named("linear", MODEL), 6)
    solver, first = Solver(problem), (np.array([-0.5]), np.array([0.2]))
    x, warm, nothing = np.array([0.01, 0.0]), np.zeros((6, 1)), np.zeros(0)
    bound = first[0][0] if wish < 0 else first[1][0]
    references = {"ur": np.full((6, 1), wish)}
    assert abs(solver.solve(x, nothing, warm, **references).v[0, 0]) > 0.5
    assert solver.solve(x, nothing, warm, **references, first=first).v[0, 0] == pytest.approx(bound, abs=1e-9)
    # The bounds are for one solve only.
    assert abs(solver.solve(x, nothing, warm, **references).v[0, 0]) > 0.5
    solver.prepare(x, nothing, np.full((6, 1), 0.1))
    assert first[0][0] <= solver.feedback(np.array([-0.3 * np.sign(wish), 0.0]), first).v[0, 0] <= first[1][0]


class Failing:
    """A solver that finds its first solution and nothing after it."""

    def __init__(self, real: Solver, good: int):
        self.real, self.good = real, good

    def solve(
        self,
        x: np.ndarray,
        theta: np.ndarray,
        warm: np.ndarray,
        xr: np.ndarray | None = None,
        ur: np.ndarray | None = None,
        first: Box | None = None,
        previous: np.ndarray | None = None,
    ) -> Solution:
        self.good -= 1
        found = self.real.solve(x, theta, warm, xr, ur, first=first)
        return found if self.good >= 0 else replace(found, status=Status.NUMERICAL)

    def prepare(
        self,
        x: np.ndarray,
        theta: np.ndarray,
        warm: np.ndarray,
        xr: np.ndarray | None = None,
        ur: np.ndarray | None = None,
        previous: np.ndarray | None = None,
    ) -> None: ...

    def feedback(
        self, x: np.ndarray, first: Box | None = None, previous: np.ndarray | None = None
    ) -> Solution:
        raise AssertionError("not in this mode")


@pytest.mark.parametrize("good", [0, 1])
def test_what_is_certified_holds_without_a_solution_too(family: Certificate, good: int) -> None:
    # A feedback that drives the plant away.
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
        # Far from where the plan was made for: it would lead anywhere.
        _, result = controller.step(state, observation(x, 1))
        assert result.mode == ("shifted_plan" if good else "feedback")
        first = result.first
        assert first is not None
        assert first.lower is not None
        assert first.upper is not None
        assert first.lower[0] <= result.plan[0, 0] <= first.upper[0]
        clipped += bool(result.plan[0, 0] != wanted[0])
    assert clipped


def test_a_row_that_bounds_nothing_is_refused(family: Certificate) -> None:
    piece = family.pieces[0]
    loose = changed(family, 0, G=[*piece.G, [1.0, 1.0]], g=[*piece.g, 2.9])
    verdict = check(loose)
    assert not verdict.ok
    assert "bounds nothing" in verdict.reason


def test_a_vertex_listed_twice_hides_no_other(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two opposite corners of a box, each of them twice: every edge is there twice, every row is touched.

    The claim is false at the other two corners only.
    """
    certificate = construct(MODEL, "box", START)
    box = {"G": [[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]], "g": [0.2, 0.2, 0.3, 0.3]}
    false = changed(certificate, 0, **box)
    assert "no input found" in check(false).reason
    corners = np.array([[0, 3], [1, 2]])
    for forged in (np.vstack([corners, corners]), np.vstack([corners, corners[:, ::-1]])):
        monkeypatch.setattr(checker, "_bases", lambda *_a, forged=forged: forged)
        assert "listed twice" in check(false).reason
    # The same rows under other names: counted from the end.
    monkeypatch.setattr(checker, "_bases", lambda *_a: np.vstack([corners, corners - 4]))
    assert "is not given by 2 of its 4 rows" in check(false).reason
    monkeypatch.setattr(checker, "_bases", lambda *_a: np.array([[0], [1], [2], [3]]))
    assert "is not given by 2 of its 4 rows" in check(false).reason
