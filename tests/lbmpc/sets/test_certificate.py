"""Certificates: the claim about sets and its check."""

from __future__ import annotations

import re

import msgspec
import numpy as np
import pytest

from lbmpc.model import build_model
from lbmpc.plants import get_plant
from lbmpc.problem import build_problem
from lbmpc.sets import check as checker
from lbmpc.sets.certificate import Certificate, CertificateError, Piece, decode, encode, require_match
from lbmpc.sets.check import check
from lbmpc.sets.construct import construct, volume_fraction
from lbmpc.sets.guard import Guard
from tests.helpers.plants.pendulum import pendulum
from tests.helpers.science import oracle_named

MODEL = pendulum()
START = np.array([0.62, 0.0])


def changed(certificate: Certificate, index: int, **fields: object) -> Certificate:
    pieces = list(certificate.pieces)
    pieces[index] = msgspec.structs.replace(pieces[index], **fields)
    return msgspec.structs.replace(certificate, pieces=pieces)


def moved_out(piece: Piece, row: int, by: float) -> list[float]:
    half = np.array([1.0, 2.0])
    return [
        g + by * np.linalg.norm(np.array(piece.G[row]) * half) * (i == row) for i, g in enumerate(piece.g)
    ]


def test_the_claim_holds_and_better_bounds_of_h_give_larger_sets(family: Certificate) -> None:
    box, hull = (construct(MODEL, kind, START) for kind in ("box", "hull"))
    verdicts = [check(c) for c in (box, hull, family)]
    assert all(v.ok and v.margin > 0 for v in verdicts)
    fractions = [volume_fraction(c) for c in (box, hull, family)]
    # For this plant the hull of h almost equals its box.
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


def test_the_checker_detects_missing_vertices(monkeypatch: pytest.MonkeyPatch, family: Certificate) -> None:
    complete = checker._bases
    monkeypatch.setattr(checker, "_bases", lambda *a: complete(*a)[1:])
    verdict = check(family)
    assert not verdict.ok
    assert "edges do not end at a known vertex" in verdict.reason


def test_a_certificate_is_read_back_bit_for_bit_and_fits_one_model(family: Certificate) -> None:
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
def test_garbage_is_refused(data: bytes, says: str) -> None:
    with pytest.raises(CertificateError, match=says):
        decode(data)


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        ({"g": [1.0]}, "G has shape"),
        ({"target": 99}, "target that does not exist"),
        ({"slope_u": [[0.0, 0.0], [0.0, 0.0]]}, "slope_u has shape"),
        ({"W": [[0.0], [0.0, 1.0]]}, "different lengths"),
    ],
)
def test_a_certificate_of_the_wrong_shape_is_refused(family: Certificate, fields: dict, says: str) -> None:
    with pytest.raises(CertificateError, match=says):
        decode(encode(changed(family, 0, **fields)))


def test_an_interrupted_construction_continues(family: Certificate) -> None:
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


def test_the_approximation_of_the_paper_is_not_certified_and_fails_the_check(family: Certificate) -> None:
    approximation = construct(MODEL, "extension", START)
    assert volume_fraction(approximation) > volume_fraction(family)
    verdict = check(approximation)
    assert not verdict.ok
    assert "not certified" in verdict.reason
    assert "no input found" in check(msgspec.structs.replace(approximation, certified=True)).reason
    with pytest.raises(CertificateError, match="not certified"):
        build_problem(MODEL, oracle_named("linear", MODEL), 5, "invariant", certificate=approximation)


def test_a_difference_in_the_last_digit_is_accepted(family: Certificate) -> None:
    again = msgspec.structs.replace(family.model, A=(np.array(family.model.A) * (1 + 3e-16)).tolist())
    require_match(msgspec.structs.replace(family, model=again), MODEL)
    other = msgspec.structs.replace(family.model, A=(np.array(family.model.A) * (1 + 1e-9)).tolist())
    with pytest.raises(CertificateError, match="A: sha256"):
        require_match(msgspec.structs.replace(family, model=other), MODEL)


def test_a_row_without_effect_is_refused(family: Certificate) -> None:
    piece = family.pieces[0]
    loose = changed(family, 0, G=[*piece.G, [1.0, 1.0]], g=[*piece.g, 2.9])
    verdict = check(loose)
    assert not verdict.ok
    assert "has no effect" in verdict.reason


def test_a_repeated_vertex_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two opposite corners of a box, each listed twice: every edge occurs twice and every row is touched.

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
    # The same rows by negative indices.
    monkeypatch.setattr(checker, "_bases", lambda *_a: np.vstack([corners, corners - 4]))
    assert "is not given by 2 of its 4 rows" in check(false).reason
    monkeypatch.setattr(checker, "_bases", lambda *_a: np.array([[0], [1], [2], [3]]))
    assert "is not given by 2 of its 4 rows" in check(false).reason
