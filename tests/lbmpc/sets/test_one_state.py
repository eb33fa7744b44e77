"""Sets of one state are intervals, which Qhull does not support."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import msgspec
import numpy as np
import pytest

from lbmpc.model import Model, build_model
from lbmpc.plants.equations import Rhs
from lbmpc.sets import check as checker
from lbmpc.sets.certificate import Certificate
from lbmpc.sets.check import check
from lbmpc.sets.construct import construct, volume_fraction
from lbmpc.sets.guard import Guard
from tests.helpers.plants.pendulum import PENDULUM


def one_state(rhs: Rhs) -> Model:
    plant = replace(
        PENDULUM,
        name="tank",
        states=("level",),
        inputs=("flow",),
        units={"level": "m", "flow": "m/s", "t": "s"},
        parameters={},
        equations=None,
        rhs=rhs,
        x_e=np.zeros(1),
        x_min=np.array([-1.0]),
        x_max=np.array([1.0]),
        u_min=np.array([-1.0]),
        u_max=np.array([1.0]),
        W=np.array([0.1]),
        x0=np.array([0.5]),
        kernel=("level", "flow"),
    )
    return build_model(plant, 0.1)


@pytest.mark.parametrize("kind", ["box", "hull", "regions", "given"])
def test_an_integrator_is_kept_in_its_whole_interval(kind: str) -> None:
    certificate = construct(one_state(lambda _x, u: [u[0]]), kind, np.array([0.5]))
    verdict = check(certificate)
    assert verdict.ok, verdict.reason
    assert verdict.vertices == 2
    assert volume_fraction(certificate) == pytest.approx(1.0)
    assert Guard(certificate).first_inputs(np.array([0.999])).piece == 0
    assert Guard(certificate).first_inputs(np.array([1.001])).upper == pytest.approx([-1.0], abs=1.0)


def test_an_unstable_state_has_a_smaller_interval_and_a_larger_one_is_refused() -> None:
    certificate = construct(one_state(lambda x, u: [2.0 * ca.sin(x[0]) + u[0]]), "box", np.zeros(1))
    assert check(certificate).ok
    piece = certificate.pieces[0]
    assert 0.2 < volume_fraction(certificate) < 0.5
    wider = replace_piece(
        certificate, g=[g + 0.05 * abs(row[0]) for row, g in zip(piece.G, piece.g, strict=True)]
    )
    assert "no input found" in check(wider).reason


def replace_piece(certificate: Certificate, **fields: object) -> Certificate:
    piece = msgspec.structs.replace(certificate.pieces[0], **fields)
    return msgspec.structs.replace(certificate, pieces=[piece])


def test_an_interval_with_one_end_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    certificate = construct(one_state(lambda _x, u: [u[0]]), "box", np.zeros(1))
    half_open = replace_piece(certificate, G=[[1.0]], g=[1.0])
    assert "unbounded" in check(half_open).reason
    complete = checker._bases
    monkeypatch.setattr(checker, "_bases", lambda *a: complete(*a)[:1])
    assert "edges do not end at a known vertex" in check(certificate).reason
