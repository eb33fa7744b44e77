"""Peak memory of a fresh process that holds one solver: `python -m benchmarks.solver.memory KIND`."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np

from benchmarks.solver import rivals
from benchmarks.solver.recording import build_case, record
from controller_node.codegen.compiler import Compiler
from lbmpc.solver.gauss_newton import Solver

STATUS = Path("/proc/self/status")
KINDS = ("packages only", "tandem, compiled", "tandem, virtual machine", "ipopt")
TICKS = 3


def measure() -> dict[str, float]:
    """Megabytes of each kind, at N = 60 with a 5-32-32-4 network; nothing on systems without /proc."""
    if not STATUS.exists():
        return {}
    found = {}
    for kind in KINDS:
        done = subprocess.run(
            [sys.executable, "-m", "benchmarks.solver.memory", kind],
            check=True,
            capture_output=True,
            text=True,
        )
        found[kind] = float(done.stdout)
    return found


def _use(kind: str) -> None:
    if kind == "packages only":
        return
    realise = Compiler() if kind != "tandem, virtual machine" else lambda function: function
    case = build_case(record(TICKS, realise), "dnn", 60, 32, realise)
    if kind == "ipopt":
        rivals.ipopt(case.problem, soft=True, gauss_newton=False).solve(
            case.x[0], case.theta[0], case.warm[0]
        )
        return
    solver = Solver(case.problem, realise=realise)
    solver.solve(case.x[0], case.theta[0], np.zeros_like(case.warm[0]))
    solver.prepare(case.x[0], case.theta[0], case.warm[0])
    solver.feedback(case.x[0])


def _peak() -> float:
    # VmHWM restarts with each program; getrusage would include the parent's memory before it.
    line = next(line for line in STATUS.read_text().splitlines() if line.startswith("VmHWM"))
    return int(line.split()[1]) / 1024


if __name__ == "__main__":
    _use(sys.argv[1])
    sys.stdout.write(f"{_peak():.1f}\n")
