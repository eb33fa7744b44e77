"""Certified sets under test: many states, worst-case disturbances, and inputs that an adversary chooses.

    python -m verification.certified_sets states sets.json --states 100000 --steps 200
    python -m verification.certified_sets closed-loop sets.json --seeds 100

From random states of the sets, the next input is whatever an adversarial oracle could make the controller choose: the
lowest or the highest that the certified bounds on v_0 allow, or one at random in between. The disturbance is the vertex
of W that pushes hardest against the nearest facet, a random point of W, or what the true plant does. The second command
is described in `verification.closed_loop`.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro

from controller_node.certified_sets import read_sets
from lbmpc.model import Model, build_model
from lbmpc.plants import get_plant
from lbmpc.sets.certificate import Certificate
from lbmpc.sets.construct import points_in
from lbmpc.sets.geometry.operations import body
from lbmpc.sets.guard import ROW_ROUNDING
from lbmpc.sets.invariance.approach import one_period
from node_runtime.realtime.scheduling import one_blas_thread
from verification.closed_loop import ClosedLoop, OracleName, cases

Disturbance = Literal["worst", "random", "true"]
CHUNK = 500


class Crowd:
    """Many states at once, each in one piece of the family."""

    def __init__(self, certificate: Certificate, model: Model, seed: int):
        self.certificate, self.model = certificate, model
        self.rng = np.random.default_rng(seed)
        low, high = (np.array(bound) for bound in certificate.model.X)
        self.half = (high - low) / 2
        self.bodies = [body(np.array(p.G), np.array(p.g), p.name, self.half) for p in certificate.pieces]
        self.rows = [Rows(certificate, i, model, self.half) for i in range(len(certificate.pieces))]
        self.move = one_period(model)

    def start(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Return states (count, d), half of them in the first piece, and the piece of each (count,)."""
        pieces = np.zeros(count, dtype=int)
        if len(self.bodies) > 1:
            pieces[count // 2 :] = self.rng.integers(1, len(self.bodies), count - count // 2)
        x = np.zeros((count, self.model.d))
        for i in np.unique(pieces):
            x[pieces == i] = points_in(self.bodies[i], int((pieces == i).sum()), self.rng)
        return x, pieces

    def step(
        self, x: np.ndarray, pieces: np.ndarray, disturbance: Disturbance
    ) -> tuple[np.ndarray, np.ndarray, int, int]:
        """Return next states and their pieces, states without a certified input, and states that left their target."""
        after, reached = np.empty_like(x), np.empty_like(pieces)
        infeasible = left = 0
        for i in np.unique(pieces):
            for part in np.array_split(np.flatnonzero(pieces == i), 1 + (pieces == i).sum() // CHUNK):
                found, bad, out = self._step_piece(x[part], i, disturbance)
                after[part], reached[part] = found, self.certificate.pieces[i].target
                infeasible, left = infeasible + bad, left + out
        return after, reached, infeasible, left

    def _step_piece(self, x: np.ndarray, i: int, disturbance: Disturbance) -> tuple[np.ndarray, int, int]:
        piece, rows = self.certificate.pieces[i], self.rows[i]
        high = np.minimum((rows.high - x @ rows.per_high.T).min(axis=1), piece.u_upper[0])
        low = np.maximum((rows.low - x @ rows.per_low.T).max(axis=1), piece.u_lower[0])
        infeasible = int((low > high).sum())
        share = self.rng.choice([0.0, 1.0, np.nan], len(x))
        share = np.where(np.isnan(share), self.rng.random(len(x)), share)
        u = (low + share * (high - low))[:, None]
        after = x @ rows.A.T + u @ rows.B.T
        if disturbance == "true":
            after = np.array(self.move.map(len(x))(x.T, u.T)).T
        elif disturbance == "random":
            after = after + self.rng.dirichlet(np.full(len(rows.W), 0.2), len(x)) @ rows.W
        else:
            nearest = np.argmin(rows.t - after @ rows.T.T, axis=1)
            after = after + rows.W[rows.pushing[nearest]]
        left = int(((rows.t - after @ rows.T.T).min(axis=1) < 0.0).sum())
        return after, infeasible, left


class Rows:
    """A piece's target in unit rows T x <= t, and its condition on u: low - per_low x <= u <= high - per_high x."""

    def __init__(self, certificate: Certificate, index: int, model: Model, half: np.ndarray):
        piece = certificate.pieces[index]
        target = certificate.pieces[piece.target]
        self.A, self.B = model.A + np.array(piece.slope_x), model.B + np.array(piece.slope_u)
        self.W, T = np.array(piece.W), np.array(target.G)
        lengths = np.linalg.norm(T * half, axis=1)
        self.T, self.t = T / lengths[:, None], np.array(target.g) / lengths
        reach = self.T @ self.W.T
        self.pushing = np.argmax(reach, axis=1)
        slope, P = (self.T @ self.B)[:, 0], self.T @ self.A
        room = self.t - reach.max(axis=1) - ROW_ROUNDING
        up, down = slope > 0, slope < 0
        self.high, self.per_high = room[up] / slope[up], P[up] / slope[up, None]
        self.low, self.per_low = room[down] / slope[down], P[down] / slope[down, None]


def states(
    file: Path,
    count: Annotated[int, tyro.conf.arg(name="states", help="How many.")] = 100_000,
    steps: int = 200,
    seed: int = 0,
) -> dict[str, float | int | str]:
    """Test many states against worst-case disturbances of all three kinds, each on its share of the states."""
    certificate = read_sets(file).certificate
    model = build_model(get_plant(certificate.model.plant), certificate.model.period)
    low, high = (np.array(bound) for bound in certificate.model.X)
    crowd = Crowd(certificate, model, seed)
    result: dict[str, float | int | str] = {
        "file": str(file.name),
        "states": count,
        "steps": steps,
        "seed": seed,
    }
    began = time.perf_counter()
    kinds: tuple[Disturbance, ...] = ("worst", "random", "true")
    for kind in kinds:
        x, pieces = crowd.start(count // len(kinds))
        infeasible = left = outside = 0
        for _ in range(steps):
            x, pieces, bad, out = crowd.step(x, pieces, kind)
            infeasible, left = infeasible + bad, left + out
            outside += int(((x < low) | (x > high)).any(axis=1).sum())
        result |= {f"{kind}_infeasible": infeasible, f"{kind}_left_set": left, f"{kind}_outside_X": outside}
    return result | {"seconds": round(time.perf_counter() - began, 1)}


def closed_loop(
    file: Path, seeds: int = 100, steps: int = 60, oracle: OracleName = "linear"
) -> dict[str, float | int | str]:
    """Run the control step with a false solver, measurement errors and late commands; count ticks outside, by case."""
    certificate = read_sets(file).certificate
    model = build_model(get_plant(certificate.model.plant), certificate.model.period)
    loop = ClosedLoop(certificate, model, oracle)
    result: dict[str, float | int | str] = {
        "file": file.name,
        "seeds": seeds,
        "steps": steps,
        "oracle": oracle,
    }
    began = time.perf_counter()
    for case in cases():
        found = [loop.run(case, seed, steps) for seed in range(seeds)]
        name = f"{case.inputs}, noise {case.noise:g}, delay {1e3 * case.delay:g} ms"
        result |= {
            f"{name}: outside": sum(one.outside for one in found),
            f"{name}: margin": float(f"{min(one.margin for one in found):.2g}"),
        }
    return result | {"seconds": round(time.perf_counter() - began, 1)}


if __name__ == "__main__":
    # The products are small, so threads would only wait for each other.
    with one_blas_thread():
        found = tyro.extras.subcommand_cli_from_dict(
            {"states": states, "closed-loop": closed_loop}, config=(tyro.conf.PositionalRequiredArgs,)
        )
        sys.stdout.write(json.dumps(found) + "\n")
