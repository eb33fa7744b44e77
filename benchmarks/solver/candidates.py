"""A common interface of everything that is timed on a recorded tick."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from benchmarks.solver.recording import Case, Recording, configure, shifted
from benchmarks.solver.rivals import Rival
from controller_node.core import ControllerCore
from lbmpc.solver.gauss_newton import Solver
from lbmpc.solver.solution import Solution, Status
from node_runtime.config.loading import override
from protocol import codec
from protocol import messages as m


@dataclass(frozen=True, slots=True)
class Part:
    """One timed part of a candidate's work on one tick."""

    mode: str
    seconds: float
    v0: np.ndarray
    """The first input of the result, (m,), deviation coordinates."""
    iterations: int
    succeeded: bool


class Runs(Protocol):
    """`run` does the work of one tick, the same at each call; `keep` goes on to the next tick."""

    def run(self, tick: int) -> list[Part]: ...

    def keep(self) -> None: ...


@dataclass(frozen=True, eq=False)
class Candidate:
    """A candidate for timing, and the labels of its rows."""

    solver: str
    case: Case
    compiled: bool
    runs: Runs
    every: int = 1
    """Ticks between two runs: slow candidates run on fewer ticks."""
    once: bool = False
    """One run on a tick; other candidates run in every round."""


class Converged:
    """This solver to convergence, from the shifted optimum of the previous tick."""

    def __init__(self, case: Case, solver: Solver):
        self._case, self._solver = case, solver

    def run(self, tick: int) -> list[Part]:
        case = self._case
        x, theta, warm = case.x[tick], case.theta[tick], case.warm[tick]
        before = time.perf_counter()
        solution = self._solver.solve(x, theta, warm)
        return [_part("converged", time.perf_counter() - before, solution, Status.CONVERGED)]

    def keep(self) -> None:
        pass


class RealTime:
    """One real-time iteration a tick, prepared at the predicted state, continuing from its *own* last plan.

    It gets the same weights as the other candidates. In a loop the preparation has those of the previous tick, which
    `WholeTick` shows.
    """

    def __init__(self, case: Case, solver: Solver):
        self._case, self._solver = case, solver
        self._last: Solution | None = None
        self._warm = case.warm[0]

    def run(self, tick: int) -> list[Part]:
        case = self._case
        predicted, theta = case.predicted[tick], case.theta[tick]
        started = time.perf_counter()
        self._solver.prepare(predicted, theta, self._warm)
        prepared = time.perf_counter()
        solution = self._solver.feedback(case.x[tick])
        done = time.perf_counter()
        self._last = solution
        return [
            _part("preparation", prepared - started, solution, Status.REAL_TIME),
            _part("feedback", done - prepared, solution, Status.REAL_TIME),
        ]

    def keep(self) -> None:
        if self._last is not None:
            self._warm = shifted(self._last)


class Other:
    """Another solver, from the same start."""

    def __init__(self, case: Case, rival: Rival):
        self._case, self._rival = case, rival

    def run(self, tick: int) -> list[Part]:
        case = self._case
        x, theta, warm = case.x[tick], case.theta[tick], case.warm[tick]
        before = time.perf_counter()
        v, iterations, succeeded = self._rival.solve(x, theta, warm)
        return [Part("converged", time.perf_counter() - before, v[0], iterations, succeeded)]

    def keep(self) -> None:
        pass


class WholeTick:
    """From the latched sample to the command's bytes: `ControllerCore.step` and the encoding."""

    def __init__(self, case: Case, recording: Recording, mode: str, compiled: bool):
        solver = f"controller.solver.mode={mode}"
        compile_ = f"controller.solver.compile={'auto' if compiled else 'never'}"
        config = override(configure(case.oracle, case.horizon, case.width), [solver, compile_])
        self._core = ControllerCore(config, "benchmark")
        self._mode = "tick" if mode == "converged" else "real_time_tick"
        self._recording = recording
        self._before = self._after = self._core.memory.state

    def run(self, tick: int) -> list[Part]:
        core = self._core
        core.memory.state = self._before
        core.prepare()
        message = self._message(tick)
        before = time.perf_counter()
        outputs = core.step(message)
        codec.encode(outputs.command)
        seconds = time.perf_counter() - before
        self._after = core.memory.state
        v0, result = np.array(outputs.command.u) - core.plant.u_e, outputs.result
        return [Part(self._mode, seconds, v0, result.iterations, result.mode == "solver")]

    def keep(self) -> None:
        self._before = self._after

    def _message(self, tick: int) -> m.Tick:
        plant, recording = self._core.plant, self._recording
        applied = None if tick == 0 else (recording.u[tick - 1] + plant.u_e).tolist()
        period = recording.model.period
        state = m.PlantState(
            run_id="recording",
            seq=tick,
            t=tick * period,
            x=(recording.x[tick] + plant.x_e).tolist(),
            applied=applied,
            source="command",
            command_seq=tick - 1,
        )
        return m.Tick.punctual("benchmark", tick, period, state)


def _part(mode: str, seconds: float, solution: Solution, expected: Status) -> Part:
    return Part(mode, seconds, solution.v[0], solution.iterations, solution.status is expected)
