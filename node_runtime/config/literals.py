"""Choices of configuration keys. They are kept in this module, so that `tandem --help` does not import numpy."""

from __future__ import annotations

from typing import Literal

OracleName = Literal["linear", "constant", "l2nw", "dnn", "perfect"]
TighteningName = Literal["none", "first_step", "tube", "invariant"]
Strategy = Literal["fifo", "reservoir", "novelty"]
StartName = Literal["random", "zero", "pretrained"]
TerminalName = Literal["riccati", "lyapunov", "published"]
EstimatorName = Literal["none", "kalman"]
LawName = Literal["gradient", "kalman"]
AdoptionName = Literal["keep", "refit"]
SolverMode = Literal["converged", "real_time"]
CompileMode = Literal["auto", "never"]
AwakeMode = Literal["auto", "always", "never"]
ProcessName = Literal["router", "plant", "controller", "trainer", "recorder"]
