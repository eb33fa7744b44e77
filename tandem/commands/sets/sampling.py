"""W of certified sets against the true plant, at random states and inputs."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from lbmpc.model import Model
from lbmpc.sets.certificate import Certificate
from lbmpc.sets.construct import points_in
from lbmpc.sets.geometry.operations import body
from lbmpc.sets.invariance.approach import one_period

HAIR = 1e-9
"""Integration error of a sample, as a share of a row's scaled length; a rigorous W is wider than that."""


@dataclass(frozen=True)
class Sampled:
    """Result; `excess` is the distance of h outside W, as a share of X's half-widths, at most 0 inside."""

    samples: int
    excess: float
    where: str


def sample(certificate: Certificate, model: Model, samples: int, seed: int = 0) -> Sampled:
    """Check that h of random states and inputs of every piece lies in its W, in the directions of its rows."""
    rng, move = np.random.default_rng(seed), one_period(model)
    half = model.plant.x_scale
    worst, where, asked = -math.inf, "", 0
    for piece in certificate.pieces:
        inside = body(np.array(piece.G), np.array(piece.g), piece.name, half)
        count = math.ceil(samples / len(certificate.pieces))
        x = points_in(inside, count, rng)
        u = rng.uniform(piece.u_lower, piece.u_upper, (count, model.m))
        after = np.asarray(move(x.T, u.T)).T
        h = after - x @ model.A.T - u @ model.B.T
        rest = h - x @ np.array(piece.slope_x).T - u @ np.array(piece.slope_u).T
        T = np.array(certificate.pieces[piece.target].G)
        T = T / np.linalg.norm(T * half, axis=1)[:, None]
        excess = (rest @ T.T - (T @ np.array(piece.W).T).max(axis=1)).max(axis=1)
        asked += count
        if excess.max() > worst:
            worst, at = float(excess.max()), int(excess.argmax())
            state, given = x[at] + model.plant.x_e, u[at] + model.plant.u_e
            where = (
                f"in piece {piece.name}, from x = {np.array2string(state, precision=6)} with u = "
                f"{np.array2string(given, precision=6)}, h is outside W by {worst:.3g} of X's half-widths"
            )
    return Sampled(asked, worst, where)
