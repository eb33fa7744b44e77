"""What is claimed of a family of sets, as data: written by the construction, read by the checker and the controller.

The claim: every piece lies in X; in every piece, for every state x there is an input u, allowed there, such that for
every w in the piece's W

    (A + slope_x) x + (B + slope_u) u + w   lies in the piece's target,

and in every piece, for every u allowed there, h(x, u) - slope_x x - slope_u u lies in its W. So from every piece the
true plant can be kept in the family, hence in X, for ever.
"""

from __future__ import annotations

import hashlib
from typing import Literal

import msgspec
import numpy as np

from lbmpc.model import Model
from lbmpc.sets.geometry.polytope import SetError

Kind = Literal["box", "hull", "regions", "given", "extension"]
FORMAT = 1
ROUNDING = 1e-12
"""Another processor may compute A and B with another last digit; every certified margin is far above it."""


LARGEST = 1e60
"""Of any number in a certificate: a product of five of them is finite."""


class CertificateError(SetError):
    """A certificate cannot be used here; the text says what differs."""


class Piece(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One set of the family, with what is known of h inside it. Deviation coordinates throughout."""

    name: str
    G: list[list[float]]
    g: list[float]
    """{x : G x <= g}; (r, d) and (r,)."""
    target: int
    """Which piece the next state is to be in."""
    slope_x: list[list[float]]
    """(d, d)"""
    slope_u: list[list[float]]
    """(d, m)"""
    W: list[list[float]]
    """Vertices (k, d)."""
    x_lower: list[float]
    x_upper: list[float]
    u_lower: list[float]
    u_upper: list[float]
    """Where W holds: a box of states around the piece, (d,), and the inputs allowed in it, (m,)."""


class ModelOf(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The model that the claim is about."""

    plant: str
    period: float
    A: list[list[float]]
    B: list[list[float]]
    x_e: list[float]
    u_e: list[float]
    X: tuple[list[float], list[float]]
    """Lower and upper bounds in deviation coordinates, (d,) each."""
    U: tuple[list[float], list[float]]


class Certificate(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A family of sets and its claim. The first piece is the one that all others lead to."""

    format: int
    kind: Kind
    certified: bool
    """False: an approximation that claims nothing, kept for comparison."""
    model: ModelOf
    pieces: list[Piece]
    source_of_W: Literal["interval arithmetic", "given"]
    slack: float
    """eps of the construction, as a share of X's half-widths."""
    steps: int
    """Of the predecessor iteration."""

    @property
    def sha256(self) -> str:
        """Of everything in it."""
        return hashlib.sha256(encode(self)).hexdigest()


def model_of(model: Model) -> ModelOf:
    plant = model.plant
    return ModelOf(
        plant.name,
        model.period,
        model.A.tolist(),
        model.B.tolist(),
        plant.x_e.tolist(),
        plant.u_e.tolist(),
        ((plant.x_min - plant.x_e).tolist(), (plant.x_max - plant.x_e).tolist()),
        ((plant.u_min - plant.u_e).tolist(), (plant.u_max - plant.u_e).tolist()),
    )


def hashes(model: ModelOf) -> dict[str, str]:
    """sha256 of each part of a model, by name."""
    return {
        name: hashlib.sha256(msgspec.msgpack.encode(getattr(model, name))).hexdigest()
        for name in model.__struct_fields__
    }


def require_match(certificate: Certificate, model: Model) -> None:
    """Raise `CertificateError`, naming what differs, unless the certificate is about this model, to rounding."""
    here, there = model_of(model), certificate.model
    mine, its = hashes(here), hashes(there)
    different = [
        name
        for name in mine
        if mine[name] != its[name] and not _rounding(getattr(here, name), getattr(there, name))
    ]
    if different:
        parts = "; ".join(
            f"{name}: sha256 {its[name][:12]} there, {mine[name][:12]} here" for name in different
        )
        raise CertificateError(
            f"the certificate is about another model ({parts}). Compute the sets again with this configuration: "
            "tandem sets compute"
        )


def _rounding(mine: object, its: object) -> bool:
    if isinstance(mine, str) or isinstance(its, str):
        return False
    left, right = np.asarray(mine, dtype=float), np.asarray(its, dtype=float)
    return left.shape == right.shape and bool((np.abs(left - right) <= ROUNDING * (1 + np.abs(left))).all())


def encode(certificate: Certificate) -> bytes:
    """JSON; numbers come back bit for bit."""
    return msgspec.json.encode(certificate)


def decode(data: bytes) -> Certificate:
    """Raises `CertificateError`: not a certificate, or inconsistent in its shapes."""
    try:
        certificate = msgspec.json.decode(data, type=Certificate)
    except msgspec.DecodeError as error:
        raise CertificateError(f"not a certificate of sets: {error}") from error
    if certificate.format != FORMAT:
        raise CertificateError(f"certificate format {certificate.format}; this version reads {FORMAT}")
    _require_shapes(certificate)
    return certificate


def _require_shapes(certificate: Certificate) -> None:
    said = certificate.model
    d, m = len(said.x_e), len(said.u_e)
    wanted = {"A": (d, d), "B": (d, m), "x_e": (d,), "u_e": (m,), "X": (2, d), "U": (2, m)}
    for name, shape in wanted.items():
        _require(getattr(said, name), f"the model's {name}", shape)
    if not certificate.pieces:
        raise CertificateError("the certificate holds no set")
    for piece in certificate.pieces:
        rows = len(piece.g)
        wanted = {
            "G": (rows, d),
            "g": (rows,),
            "slope_x": (d, d),
            "slope_u": (d, m),
            "x_lower": (d,),
            "x_upper": (d,),
            "u_lower": (m,),
            "u_upper": (m,),
            "W": (len(piece.W), d),
        }
        for name, shape in wanted.items():
            _require(getattr(piece, name), f"piece {piece.name!r}: {name}", shape)
        if not (rows and len(piece.W) and 0 <= piece.target < len(certificate.pieces)):
            raise CertificateError(f"piece {piece.name!r}: no rows, no W, or a target that is not there")
        if not (np.abs(np.array(piece.G)).max(axis=1) >= 1 / LARGEST).all():
            raise CertificateError(f"piece {piece.name!r}: a row of G has no direction")
        lower, upper = np.array(piece.u_lower), np.array(piece.u_upper)
        if not ((said.U[0] <= lower) & (lower <= upper) & (upper <= said.U[1])).all():
            raise CertificateError(
                f"piece {piece.name!r}: the inputs allowed are not in order, or outside of U"
            )


def _require(value: object, what: str, shape: tuple[int, ...]) -> None:
    try:
        array = np.array(value, dtype=float)
    except ValueError as error:
        raise CertificateError(f"{what}: its rows have different lengths") from error
    if array.shape != shape:
        raise CertificateError(f"{what} has shape {array.shape}, not {shape}")
    if not (np.abs(array) <= LARGEST).all():
        raise CertificateError(f"{what}: not finite, or beyond {LARGEST:g}")
