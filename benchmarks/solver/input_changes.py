"""Cost of rate limits and of a weight on input changes in a solve: `python -m benchmarks.solver.input_changes`.

The same recorded states and networks are solved with and without them, in turn, in one run, each from its own last
plan. The limit is so low that it is active in most of the solves.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass

import numpy as np
import tyro
from rich.console import Console

from benchmarks.solver.recording import SEED, Recording, configure, record, shifted
from controller_node.build import Realise, build_model, build_oracle
from controller_node.codegen.compiler import Compiler
from lbmpc.problem import build_problem
from lbmpc.solver.gauss_newton import Solver
from node_runtime.config.literals import OracleName
from node_runtime.config.loading import override
from node_runtime.realtime.scheduling import GarbageCollection, one_blas_thread, punctual

VARIANTS: dict[str, list[str]] = {
    "neither": [],
    "limit": ["plant.input_rate_max.u=0.5"],
    "S": ["controller.S=[10.0]"],
    "limit and S": ["plant.input_rate_max.u=0.5", "controller.S=[10.0]"],
}
MODES = ("converged", "preparation", "feedback")


@dataclass(frozen=True)
class Arguments:
    """A solve with rate limits and S beside one without."""

    oracle: OracleName = "dnn"
    horizon: int = 60
    width: int = 64
    ticks: int = 60
    rounds: int = 5


class Timed:
    """One variant, continuing from its own last plans."""

    def __init__(self, chosen: Arguments, settings: list[str], realise: Realise):
        config = override(configure(chosen.oracle, chosen.horizon, chosen.width), settings)
        model, tightening = build_model(config), config.controller.tightening
        self.oracle = build_oracle(config, model)
        self._solver = Solver(build_problem(model, self.oracle, chosen.horizon, tightening), realise=realise)
        self._warm = self._next = np.zeros((chosen.horizon, model.m))
        self.seconds: dict[str, list[float]] = {mode: [] for mode in MODES}
        self.iterations: list[int] = []

    def run(self, x: np.ndarray, predicted: np.ndarray, theta: np.ndarray, previous: np.ndarray) -> None:
        began = time.perf_counter()
        solution = self._solver.solve(x, theta, self._warm, previous=previous)
        solved = time.perf_counter()
        self._solver.prepare(predicted, theta, self._warm, previous=previous)
        prepared = time.perf_counter()
        self._solver.feedback(x, previous=previous)
        ended = time.perf_counter()
        for mode, seconds in zip(MODES, (solved - began, prepared - solved, ended - prepared), strict=True):
            self.seconds[mode].append(seconds)
        self.iterations.append(solution.iterations)
        self._next = shifted(solution)

    def keep(self) -> None:
        self._warm = self._next


def measure(chosen: Arguments, realise: Realise) -> dict[str, Timed]:
    """Run every variant at every recorded tick, `rounds` times, in turn; the first round warms it up."""
    recording: Recording = record(chosen.ticks, realise)
    variants = {name: Timed(chosen, settings, realise) for name, settings in VARIANTS.items()}
    oracle, model = variants["neither"].oracle, recording.model
    memory, predicted, previous = (
        oracle.initial_state(np.random.default_rng(SEED)),
        recording.x[0],
        recording.u[0],
    )
    garbage = GarbageCollection()
    garbage.begin()
    for tick, (x, u, h) in enumerate(zip(recording.x, recording.u, recording.h, strict=True)):
        theta = oracle.theta(memory)
        for _round in range(chosen.rounds + (tick == 0)):
            for one in variants.values():
                one.run(x, predicted, theta, previous)
        for one in variants.values():
            if tick == 0:
                one.seconds, one.iterations = {mode: [] for mode in MODES}, []
            one.keep()
        garbage.idle()
        predicted, previous = model.A @ x + model.B @ u + oracle.estimate(memory, x, u), u
        memory = oracle.learn(memory, x, u, h)
    return variants


def main(chosen: Arguments) -> int:
    console = Console(width=160, highlight=False)
    with punctual(0), one_blas_thread():
        variants = measure(chosen, Compiler(None))
    console.print(
        f"{chosen.oracle}, N = {chosen.horizon}: median / p99 in ms (ratio to neither), mean iterations"
    )
    plain = variants["neither"]
    for name, one in variants.items():
        cells = []
        for mode in MODES:
            own, other = (np.percentile(each.seconds[mode], [50, 99]) * 1e3 for each in (one, plain))
            ratios = own / other
            cells.append(f"{mode} {own[0]:.3f} / {own[1]:.3f} ({ratios[0]:.2f} / {ratios[1]:.2f})")
        console.print(f"{name:12s} | {' | '.join(cells)} | {np.mean(one.iterations):.2f}")
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Arguments, prog="python -m benchmarks.solver.input_changes")))
