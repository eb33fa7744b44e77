"""Certificates: the claim about a family of sets as data. The construction writes it; checker and controller read it.

The claim: every piece lies in X. In every piece, for every state x there is an allowed input u such that for every w in
the piece's W

    (A + slope_x) x + (B + slope_u) u + w   lies in the piece's target.

In every piece and for every allowed u, h(x, u) - slope_x x - slope_u u lies in its W. The true plant can therefore be
kept in the family, and so in X, for all time.
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
"""Relative tolerance for A and B, whose last digit depends on the processor. Certified margins are far larger."""


LARGEST = 1e60
"""Largest number in a certificate, such that a product of five is finite."""


class CertificateError(SetError):
    """A certificate cannot be used here. The text says why."""


class Piece(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One set of the family and the bound of h inside it, in deviation coordinates."""

    name: str
    G: list[list[float]]
    g: list[float]
    """{x : G x <= g}; (r, d) and (r,)."""
    target: int
    """Index of the piece that contains the next state."""
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
    """Validity of W: a box of states around the piece, (d,), and the allowed inputs, (m,)."""


class ModelOf(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The model that the claim refers to."""

    plant: str
    period: float
    A: list[list[float]]
    B: list[list[float]]
    x_e: list[float]
    u_e: list[float]
    X: tuple[list[float], list[float]]
    """Lower and upper bounds in deviations, (d,) each."""
    U: tuple[list[float], list[float]]


class Certificate(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A family of sets and its claim. All other pieces lead to the first one."""

    format: int
    kind: Kind
    certified: bool
    """False for an approximation without a claim, for comparison."""
    model: ModelOf
    pieces: list[Piece]
    source_of_W: Literal["interval arithmetic", "given"]
    slack: float
    """eps of the construction, as a share of the half-widths of X."""
    steps: int
    """Steps of the predecessor iteration."""

    @property
    def sha256(self) -> str:
        """SHA-256 of all fields."""
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
    """Return the SHA-256 of each part of a model, by name."""
    return {
        name: hashlib.sha256(msgspec.msgpack.encode(getattr(model, name))).hexdigest()
        for name in model.__struct_fields__
    }


def require_match(certificate: Certificate, model: Model) -> None:
    """Raise `CertificateError` with the differences unless the certificate is for this model, up to rounding."""
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
            f"the certificate is for another model ({parts}). Compute the sets again with this configuration: "
            "tandem sets compute"
        )


def _rounding(mine: object, its: object) -> bool:
    if isinstance(mine, str) or isinstance(its, str):
        return False
    left, right = np.asarray(mine, dtype=float), np.asarray(its, dtype=float)
    return left.shape == right.shape and bool((np.abs(left - right) <= ROUNDING * (1 + np.abs(left))).all())


def encode(certificate: Certificate) -> bytes:
    """Return JSON from which numbers are read back exactly."""
    return msgspec.json.encode(certificate)


def decode(data: bytes) -> Certificate:
    """Raise `CertificateError` for data that is no certificate or has inconsistent shapes."""
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
        raise CertificateError("the certificate contains no set")
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
            raise CertificateError(f"piece {piece.name!r}: no rows, no W, or a target that does not exist")
        if not (np.abs(np.array(piece.G)).max(axis=1) >= 1 / LARGEST).all():
            raise CertificateError(f"piece {piece.name!r}: a row of G has no direction")
        lower, upper = np.array(piece.u_lower), np.array(piece.u_upper)
        if not ((said.U[0] <= lower) & (lower <= upper) & (upper <= said.U[1])).all():
            raise CertificateError(
                f"piece {piece.name!r}: the bounds of the allowed inputs are not in order, or outside U"
            )


def _require(value: object, what: str, shape: tuple[int, ...]) -> None:
    try:
        array = np.array(value, dtype=float)
    except ValueError as error:
        raise CertificateError(f"{what}: its rows have different lengths") from error
    if array.shape != shape:
        raise CertificateError(f"{what} has shape {array.shape}, not {shape}")
    if not (np.abs(array) <= LARGEST).all():
        raise CertificateError(f"{what}: not finite, or above {LARGEST:g}")
