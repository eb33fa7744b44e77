"""The guard and the delay under test: a controller with a false solver, measurement errors and late commands.

    python -m verification.certified_sets closed-loop sets.json --seeds 100

The whole control step runs, guard and prediction included; only the solver is replaced, by one that takes any input
inside the bounds that it is given: one at random, or one of their ends. A state counts as outside by the true state at
the moment from which the command acts.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import casadi as ca
import numpy as np

from lbmpc.controller.signals import Observation
from lbmpc.controller.step import Controller
from lbmpc.model import Model
from lbmpc.oracles import LinearOracle, Oracle, PerfectOracle
from lbmpc.oracles.base import OracleState
from lbmpc.plants.linear_motion import Pieces
from lbmpc.plants.truth import dop853
from lbmpc.problem import build_problem
from lbmpc.sets.certificate import Certificate
from lbmpc.sets.guard import Guard
from lbmpc.sets.invariance.approach import STEP_NORM
from lbmpc.solver.constraint_rows import Box
from lbmpc.solver.solution import Solution, Status

Inputs = Literal["random", "bang-bang"]
OracleName = Literal["linear", "perfect", "lying"]
HORIZON = 3


@dataclass(frozen=True)
class Case:
    """The errors of a run, and the source of its inputs."""

    inputs: Inputs
    noise: float = 0.0
    """Bound of each state's measurement error, uniform, as a share of X's half-width."""
    delay: float = 0.0
    """Seconds from a sample until its command acts."""
    known: bool = True
    """Whether the controller begins with this delay, or with none."""


class LyingSolver:
    """A solver that returns any input inside the bounds of the first input."""

    def __init__(self, model: Model, inputs: Inputs, rng: np.random.Generator):
        self._model, self._inputs, self._rng = model, inputs, rng

    def solve(
        self,
        x: np.ndarray,
        oracle_parameters: np.ndarray,
        warm_start: np.ndarray,
        xr: np.ndarray | None = None,
        ur: np.ndarray | None = None,
        first: Box | None = None,
        previous: np.ndarray | None = None,
    ) -> Solution:
        plant, m = self._model.plant, self._model.m
        low, high = (plant.u_min - plant.u_e, plant.u_max - plant.u_e) if first is None else first
        share = self._rng.random(m) if self._inputs == "random" else self._rng.integers(0, 2, m)
        v = np.vstack([low + share * (high - low), warm_start[1:]])
        return Solution(
            Status.CONVERGED, v, warm_start, v, np.zeros((len(v), self._model.d)), 0.0, 0, 0.0, ""
        )

    def prepare(
        self,
        x: np.ndarray,
        oracle_parameters: np.ndarray,
        warm_start: np.ndarray,
        xr: np.ndarray | None = None,
        ur: np.ndarray | None = None,
        previous: np.ndarray | None = None,
    ) -> None:
        """Never asked."""

    def feedback(
        self, x: np.ndarray, first: Box | None = None, previous: np.ndarray | None = None
    ) -> Solution:
        raise AssertionError("only asked to solve")


class LyingOracle(LinearOracle):
    """An oracle whose h is a tenth of X's half-widths for every state: the sets must hold without it."""

    def __init__(self, model: Model):
        super().__init__(model.d, model.m)
        self._h = 0.1 * model.plant.x_scale

    def estimate(self, state: OracleState, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        return self._h


@dataclass(frozen=True)
class Found:
    """Of one run: ticks with the true state outside the sets, and its smallest margin."""

    outside: int
    margin: float


class ClosedLoop:
    """A plant and its controller. The sets hold for any oracle, also over a delay."""

    def __init__(self, certificate: Certificate, model: Model, oracle: OracleName = "linear"):
        self.certificate, self.model, self._flow = certificate, model, _flow(model)
        chosen: dict[OracleName, Callable[[], Oracle]] = {
            "linear": lambda: LinearOracle(model.d, model.m),
            "perfect": lambda: PerfectOracle(model),
            "lying": lambda: LyingOracle(model),
        }
        self._problem = build_problem(model, chosen[oracle](), HORIZON, "invariant", certificate=certificate)
        self._judge = Guard(certificate)

    def run(self, case: Case, seed: int, steps: int, x0: np.ndarray | None = None) -> Found:
        """Run from x0, (d,), a deviation, by default the plant's own; it is held until the first command acts."""
        rng, plant, period = np.random.default_rng(seed), self.model.plant, self.model.period
        half = (plant.x_max - plant.x_min) / 2
        solver = LyingSolver(self.model, case.inputs, rng)
        controller = Controller(self._problem, solver, input_delay=case.delay if case.known else 0.0)
        state, x = controller.initial_state(0), plant.x0 - plant.x_e if x0 is None else x0
        applied: np.ndarray | None = None
        pieces: Pieces = ()
        before, outside, margin = None, 0, np.inf
        for number in range(steps):
            measured = x + case.noise * half * rng.uniform(-1.0, 1.0, self.model.d)
            state, result = controller.step(state, Observation(measured, applied, 1, number, None, pieces))
            u = result.plan[0]
            acting = x if before is None else self._moved(x, before, case.delay)
            here = float(self._judge.margins(acting).max())
            x = self._moved(acting, u, period - case.delay)
            if not (np.isfinite(here) and np.isfinite(x).all()):
                return Found(outside + steps - number, -np.inf)
            outside, margin = outside + (here < 0.0), min(margin, here)
            # As the plant reports it: the inputs that acted, if there were several or not a whole period of one.
            rest = (period - case.delay, u)
            if not case.delay:
                applied = u
            elif before is None:
                pieces = (rest,)
            else:
                pieces = ((case.delay, before), rest)
                applied = (case.delay * before + rest[0] * u) / period
            before = u
        return Found(outside, margin)

    def _moved(self, x: np.ndarray, u: np.ndarray, seconds: float) -> np.ndarray:
        return np.asarray(self._flow(x, u, seconds)).ravel()


def _flow(model: Model) -> ca.Function:
    """(x, u, seconds), deviations -> the true plant's state, (d,), for up to a period; as `one_period`."""
    plant, equations = model.plant, model.require_equations("this check")
    f = equations.function()
    x, u, seconds = ca.SX.sym("x", model.d), ca.SX.sym("u", model.m), ca.SX.sym("seconds")
    norm = float(np.abs(np.linalg.eigvals(equations.linearised()[1])).max()) * model.period
    steps = max(1, math.ceil(norm / STEP_NORM))
    after = x + plant.x_e
    for _ in range(steps):
        after = dop853(f, after, u + plant.u_e, seconds / steps).after
    return ca.Function("flow", [x, u, seconds], [after - plant.x_e])


def cases() -> list[Case]:
    """Every kind of measurement error, and every delay with the largest of them, for both kinds of inputs."""
    kinds: tuple[Inputs, ...] = ("random", "bang-bang")
    noisy = [Case(inputs, noise) for inputs in kinds for noise in (1e-7, 1e-6)]
    return noisy + [
        Case(inputs, noise, delay)
        for inputs in kinds
        for delay in (0.002, 0.01, 0.025)
        for noise in (0.0, 1e-6)
    ]
