"""Forged certified sets with a right hash, and the states that a guard is asked about.

A log holds its sets, and a replay checks their hash at most. Their content must be refused or handled.
"""

from __future__ import annotations

import random
import struct
from collections.abc import Callable, Sequence

import msgspec
import numpy as np

from controller_node.certified_sets import SHIPPED, CertifiedSets, Found, read_sets
from lbmpc.controller.signals import Observation
from lbmpc.controller.step import Controller
from lbmpc.model import build_model
from lbmpc.oracles import LinearOracle
from lbmpc.plants import get_plant
from lbmpc.problem import build_problem
from lbmpc.sets.certificate import Certificate, CertificateError, require_match
from lbmpc.sets.check import check
from lbmpc.sets.guard import Guard
from verification.closed_loop import HORIZON, LyingSolver

NUMBERS = (0.0, -0.0, 1e-300, 1e-9, 0.1, -0.4, 1.0, 1e5, 1e6, -1e7, 1e150, 1e308, float("inf"), float("nan"))
PERIOD = 0.05


def small_sets() -> Certificate:
    """One small shipped set, changed to lead to itself."""
    shipped = read_sets(min(SHIPPED.glob("*.json*"), key=lambda path: path.stat().st_size)).certificate
    last = min(shipped.pieces, key=lambda piece: len(piece.g))
    return msgspec.structs.replace(shipped, pieces=[msgspec.structs.replace(last, target=0)])


def forged(certificate: Certificate) -> Callable[[bytes], str]:
    """What a replay does with the sets of a log, and `tandem sets check` with those of a file."""
    model = build_model(get_plant(certificate.model.plant), certificate.model.period)
    states = np.random.default_rng(0).uniform(-0.5, 0.5, (3, model.d)) * model.plant.x_scale
    found = Found(0.5, 0.1, True, 1.0)

    def read(payload: bytes) -> str:
        raw = CertifiedSets.of(certificate, found)
        try:
            said = msgspec.json.decode(payload, type=Certificate)
            raw = CertifiedSets.of(said, found)
        except msgspec.DecodeError:
            return "not a certificate"
        try:
            sets = CertifiedSets.from_bytes(raw.to_bytes())
            require_match(sets.certificate, model)
        except CertificateError:
            return "refused"
        # Numbers at the end of the range of a float overflow; this is expected.
        with np.errstate(all="ignore"):
            verdict = check(sets.certificate)
            if sets.certificate.certified:
                guard = Guard(sets.certificate)
                for x in states:
                    _require_bounds(guard, x)
        return "accepted" if verdict.ok else "the claim does not hold"

    return read


def asked(certificate: Certificate) -> Callable[[bytes], str]:
    """A measured state, an input and a delay, as numbers: the whole control step, bounds of the guard included."""
    model = build_model(get_plant(certificate.model.plant), certificate.model.period)
    problem = build_problem(
        model, LinearOracle(model.d, model.m), HORIZON, "invariant", certificate=certificate
    )
    controller = Controller(problem, LyingSolver(model, "bang-bang", np.random.default_rng(0)))
    fresh = controller.initial_state(0)
    low, high = np.array(certificate.model.U)

    def read(payload: bytes) -> str:
        x, u, seconds = np.split(
            np.frombuffer(payload[: 8 * (model.d + model.m + 1)]), [model.d, model.d + model.m]
        )
        late = float(np.nan_to_num(np.clip(seconds[0], 0.0, model.period)))
        pieces = ((late, u), (model.period - late, u))
        with np.errstate(all="ignore"):
            state, first = controller.step(fresh, Observation(x, u, 1, 0, None, pieces))
            _state, second = controller.step(state, Observation(x, u, 1, 1, None, pieces))
        for result in (first, second):
            assert np.isfinite(result.plan).all(), "a plan that is not finite"
            assert (result.plan[0] >= low).all(), "below U"
            assert (result.plan[0] <= high).all(), "above U"
        return "accepted" if first.first is not None else "no state"

    return read


class States:
    """Endless states, inputs and delays: plausible, and partly extreme."""

    def __init__(self, certificate: Certificate, seed: int):
        self._rng = random.Random(seed)
        self._scale: Sequence[float] = [0.5, 0.5, 1.0, 20.0, 1.0][: len(certificate.model.A) + 1]

    def __call__(self) -> bytes:
        rng = self._rng
        values = [scale * rng.uniform(-1.2, 1.2) for scale in self._scale] + [rng.uniform(0.0, PERIOD)]
        for _ in range(rng.choice((0, 1, 2))):
            values[rng.randrange(len(values))] = rng.choice(NUMBERS)
        return struct.pack(f"{len(values)}d", *values)


def _require_bounds(guard: Guard, x: np.ndarray) -> None:
    first = guard.first_inputs(x)
    if first.lower is None or first.upper is None:
        return
    assert (first.lower <= first.upper).all(), "bounds that cross"
    low, high = np.array(guard.certificate.model.U)
    assert (first.lower >= low).all(), "below U"
    assert (first.upper <= high).all(), "above U"
