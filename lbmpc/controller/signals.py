"""The inputs and results of a control step, in deviation coordinates."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from lbmpc.oracles.base import HiddenSet, Verdict
from lbmpc.plants.linear_motion import Pieces
from lbmpc.references import Change
from lbmpc.sets.guard import FirstInputs
from lbmpc.solver.solution import Solution
from lbmpc.targets import SteadyState

Mode = Literal["solver", "shifted_plan", "feedback"]


@dataclass(frozen=True, eq=False)
class Observation:
    """The input of a step. x (d,) and applied (m,) are deviations; None if they are missing."""

    x: np.ndarray | None
    applied: np.ndarray | None
    """Mean input over the period that ended with x."""
    source: int
    """Identifies one incarnation of the plant. A label never spans two of them."""
    sequence: int
    """Number of the sample. A label needs two consecutive ones."""
    hidden: HiddenSet | None
    pieces: Pieces = ()
    """The inputs of that period if there were several, in deviations. Without `applied` only the last one is used, as
    the input that acts now."""
    truth: Mapping[str, float] = field(default_factory=dict)
    """Changed parameters of the true plant, by name, for the oracle `perfect`."""
    reference: Change | None = None
    """A change of the reference from now on; None if there is none."""
    skipped: int = 0
    """Periods without a step since the last one."""


@dataclass(frozen=True, eq=False)
class Label:
    """A labelled sample: x_t, the input until t + 1, and h(x_t, u_t) = x_{t+1} - A x_t - B u_t."""

    x: np.ndarray
    u: np.ndarray
    h: np.ndarray
    h_hat: np.ndarray
    """The oracle's estimate before it learned this sample."""
    past: np.ndarray
    """The k - 1 pairs (x, u) before this one as the oracle used them, (k - 1, d + m), oldest first."""
    variance: np.ndarray
    """Variance of h, (d,); zeros if a sample is the state."""


@dataclass(frozen=True, eq=False)
class StepResult:
    """The result of a step, in deviation coordinates. plan is (N, m); plan[0] is the input for now."""

    plan: np.ndarray
    mode: Mode
    solution: Solution | None
    label: Label | None
    verdict: Verdict
    """The decision on the offered hidden layers."""
    rolled_back: str
    """The reason for a rollback of the hidden weights and K; empty without one."""
    delay: float
    """Seconds over which the sample was predicted, to the time when the command acts."""
    first: FirstInputs | None
    """The certified bounds of v_0; None without certified sets or without a state."""
    target: SteadyState | None
    """The target of the plan; None without a reference, when the target is the equilibrium."""
    weights: np.ndarray
    """Weight of each part of h_hat in the prediction, (parts, d), 0 to 1; (0, d) for an oracle without weights."""
    deviation: np.ndarray
    """Standard deviation of the estimated state, (d,); (0,) if a sample is the state."""
    sensor_faults: dict[str, str]
    """Distrusted sensors: state name to a description of the fault."""
    noise: np.ndarray
    """Standard deviation of the measurement noise found by the estimator, (d,); (0,) if it was configured."""

    @property
    def new_network(self) -> bool:
        """Whether the hidden layers in use change with this step."""
        return self.verdict.outcome == "adopted" or bool(self.rolled_back)
