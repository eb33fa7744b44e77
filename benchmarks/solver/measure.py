"""`python -m benchmarks.solver`: every candidate on every recorded state, in turn, in one process."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import casadi as ca
import msgspec
import numpy as np

from benchmarks.solver import memory
from benchmarks.solver.candidates import Candidate, Converged, Other, Part, RealTime, WholeTick
from benchmarks.solver.recording import SEED, Case, Recording, build_case, record
from benchmarks.solver.rivals import QP_SOLVERS, Rival, ipopt, sqpmethod
from controller_node.build import Realise
from controller_node.codegen.compiler import Compiler
from lbmpc.solver.gauss_newton import Solver
from node_runtime import provenance
from node_runtime.config.literals import OracleName
from node_runtime.realtime.scheduling import GarbageCollection, punctual

Progress = Callable[[str, int, int], None]
"""Called with the present step, its number and the number of steps."""
ORACLES: tuple[OracleName, ...] = ("linear", "constant", "l2nw", "dnn")
CENTRE, WIDTH = 60, 32
"""The horizon and the width at which all candidates are compared."""


@dataclass(frozen=True)
class Scope:
    """What is measured."""

    ticks: int = 60
    rounds: int = 3
    """Repetitions of each tick for fast candidates."""
    horizons: tuple[int, ...] = (10, 20, 60, 100, 200)
    """With networks of width 32."""
    widths: tuple[int, ...] = (16, 32, 64, 128, 256)
    """With the horizon 60."""
    oracles: tuple[OracleName, ...] = ORACLES
    rival_horizons: tuple[int, ...] = (20, 60, 100)
    rival_every: int = 6
    """Ticks between two runs of a rival."""
    compile: bool = True
    memory: bool = True
    centre: int = CENTRE


QUICK = Scope(
    ticks=20, rounds=2, horizons=(20, 60), widths=(32,), rival_horizons=(60,), rival_every=5, memory=False
)


class Row(msgspec.Struct, frozen=True):
    """One candidate's figures. Times in milliseconds."""

    solver: str
    """"tandem", or a rival: "ipopt" has soft state bounds as the problem has, "ipopt-hard" hard ones."""
    mode: str
    """"converged", "preparation", "feedback"; "tick" and "real_time_tick": from the latched sample to bytes."""
    oracle: str
    N: int
    width: int | None
    """Neurons in each of the two hidden layers; None without a network."""
    compiled: bool
    median_ms: float
    p99_ms: float
    max_ms: float
    cold_median_ms: float
    """Median of runs whose caches hold another candidate's data."""
    iterations: float
    """Mean."""
    error: float
    """Largest distance of the first input from the tight optimum, input units."""
    solves: int
    failures: int
    """Solves with another status than expected, such as the iteration limit."""


class Report(msgspec.Struct, frozen=True):
    """All of one run."""

    rows: list[Row]
    memory_mb: dict[str, float]
    """Peak resident memory of a process that does only this."""
    machine: dict[str, str]
    versions: dict[str, str]
    notes: list[str]
    load: float
    """Average number of runnable processes meanwhile: more than the cores makes times too long."""

    def find(
        self, solver: str, mode: str, oracle: str, N: int, width: int | None, compiled: bool
    ) -> Row | None:
        """The row of that name, if it was measured."""
        wanted = (solver, mode, oracle, N, width, compiled)
        same = (
            row
            for row in self.rows
            if (row.solver, row.mode, row.oracle, row.N, row.width, row.compiled) == wanted
        )
        return next(same, None)


@dataclass
class _Taken:
    """The measurements of one candidate's one mode."""

    seconds: list[float] = field(default_factory=list)
    first_seconds: list[float] = field(default_factory=list)
    iterations: list[int] = field(default_factory=list)
    error: float = 0.0
    failures: int = 0


def measure(
    scope: Scope, progress: Progress = lambda _what, _done, _of: None, cache: Path | None = None
) -> Report:
    """Build everything, warm it up, then go through the ticks.

    Each tick is given to every candidate before the next tick begins, in a new random order each round, so that
    other load affects all candidates alike. A turn is the same work twice: the first run has the caches full
    of the previous candidate's data (`cold_median_ms`), the second one counts. Garbage is collected between
    ticks.

    Args:
        scope: what to measure.
        progress: told how far it is.
        cache: where compiled functions are kept; None: the usual place.
    """
    used = memory.measure() if scope.memory else {}
    with punctual(0):
        compiler = Compiler(cache) if scope.compile else None
        recording = record(scope.ticks, compiler)
        candidates, notes = _build(scope, recording, compiler, progress)
        taken = _run(scope, candidates, progress)
    rows = [
        _row(candidate, mode, figures)
        for candidate, modes in zip(candidates, taken, strict=True)
        for mode, figures in modes.items()
    ]
    if compiler is not None:
        notes.append(compiler.note)
    return Report(
        rows, used, provenance.describe(), provenance.versions(provenance.SCIENCE), notes, provenance.load()
    )


def _build(
    scope: Scope, recording: Recording, compiler: Compiler | None, progress: Progress
) -> tuple[list[Candidate], list[str]]:
    shapes = _shapes(scope)
    candidates: list[Candidate] = []
    notes: list[str] = []
    for done, (oracle, horizon, width) in enumerate(shapes):
        progress("building", done, len(shapes))
        case = build_case(recording, oracle, horizon, width, compiler or _as_it_is)
        if case.unsure:
            notes.append(
                f"{oracle}, N = {horizon}: the tight reference stopped above its tolerance at {case.unsure} ticks"
            )
        for candidate in _candidates(scope, case, recording, compiler):
            if candidate.compiled and compiler is not None and compiler.note.startswith("not compiled"):
                # It would be the virtual machine under another name.
                continue
            candidates.append(candidate)
    return candidates, notes


def _shapes(scope: Scope) -> list[tuple[OracleName, int, int | None]]:
    """Every problem, once."""
    shapes: list[tuple[OracleName, int, int | None]] = [
        (oracle, horizon, WIDTH if oracle == "dnn" else None)
        for horizon in scope.horizons
        for oracle in scope.oracles
    ]
    if "dnn" in scope.oracles:
        shapes += [("dnn", scope.centre, width) for width in scope.widths]
    return list(dict.fromkeys(shapes))


def _candidates(
    scope: Scope, case: Case, recording: Recording, compiler: Compiler | None
) -> Iterator[Candidate]:
    ways: list[tuple[bool, Realise]] = [(False, _as_it_is)]
    if compiler is not None:
        ways.insert(0, (True, compiler))
    for compiled, realise in ways:
        for way in (Converged, RealTime):
            yield Candidate("tandem", case, compiled, way(case, Solver(case.problem, realise=realise)))
    if case.width not in (None, WIDTH):
        return
    if case.horizon == scope.centre:
        for mode in ("converged", "real_time"):
            compiled = compiler is not None
            yield Candidate("tandem", case, compiled, WholeTick(case, recording, mode, compiled))
    if case.horizon in scope.rival_horizons:
        for name, rival in _rivals(case):
            yield Candidate(name, case, False, Other(case, rival), scope.rival_every, once=True)


def _rivals(case: Case) -> Iterator[tuple[str, Rival]]:
    problem = case.problem
    if case.oracle in ("linear", "dnn"):
        yield "ipopt", ipopt(problem, soft=True, gauss_newton=False)
        yield "ipopt-hard", ipopt(problem, soft=False, gauss_newton=False)
    if case.oracle == "dnn":
        yield "ipopt-hard-gauss-newton", ipopt(problem, soft=False, gauss_newton=True)
        for qp in QP_SOLVERS:
            yield f"sqpmethod-{qp}", sqpmethod(problem, qp)


def _as_it_is(function: ca.Function) -> ca.Function:
    return function


def _run(scope: Scope, candidates: list[Candidate], progress: Progress) -> list[dict[str, _Taken]]:
    taken: list[dict[str, _Taken]] = [defaultdict(_Taken) for _ in candidates]
    order = np.random.default_rng(SEED)
    garbage = GarbageCollection(every=1)
    garbage.begin()
    for tick in range(scope.ticks):
        progress("measuring", tick, scope.ticks)
        for round_ in range(scope.rounds):
            for index in order.permutation(len(candidates)):
                candidate = candidates[index]
                if tick % candidate.every or (candidate.once and round_):
                    continue
                first, parts = candidate.runs.run(tick), candidate.runs.run(tick)
                # The first tick warms up: no candidate had a plan yet.
                if tick:
                    _note(taken[index], first, parts, candidate.case.tight[tick].v[0])
        for candidate in candidates:
            candidate.runs.keep()
        garbage.idle()
    progress("measuring", scope.ticks, scope.ticks)
    return taken


def _note(taken: dict[str, _Taken], first: list[Part], parts: list[Part], tight: np.ndarray) -> None:
    for before, part in zip(first, parts, strict=True):
        figures = taken[part.mode]
        figures.first_seconds.append(before.seconds)
        figures.seconds.append(part.seconds)
        figures.iterations.append(part.iterations)
        figures.error = max(figures.error, float(np.abs(part.v0 - tight).max()))
        figures.failures += not part.succeeded


def _row(candidate: Candidate, mode: str, figures: _Taken) -> Row:
    case, ms = candidate.case, np.array(figures.seconds) * 1e3
    return Row(
        candidate.solver,
        mode,
        case.oracle,
        case.horizon,
        case.width,
        candidate.compiled,
        float(np.median(ms)),
        float(np.percentile(ms, 99)),
        float(ms.max()),
        float(np.median(figures.first_seconds) * 1e3),
        float(np.mean(figures.iterations)),
        figures.error,
        len(ms),
        figures.failures,
    )
