"""What goes into a control step and what comes out of it, in deviation coordinates."""

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
    """What a step may depend on. x (d,) and applied (m,) are deviations; None where there was none."""

    x: np.ndarray | None
    applied: np.ndarray | None
    """Mean input over the period that ended with x."""
    source: int
    """Which incarnation of the plant sent x; labels never span two."""
    sequence: int
    """Its sample number; a label needs two consecutive ones."""
    hidden: HiddenSet | None
    pieces: Pieces = ()
    """The inputs of that period where there were several, deviations. Without `applied` only the last counts: it acts
    now."""
    truth: Mapping[str, float] = field(default_factory=dict)
    """Parameters of the true plant that are others from now on, by name; for the oracle that knows the truth."""
    reference: Change | None = None
    """Where the outputs should be from now on; None: as before."""
    skipped: int = 0
    """Periods without a step since the last one."""


@dataclass(frozen=True, eq=False)
class Label:
    """One labelled sample: x_t, the input applied until t + 1, and h(x_t, u_t) = x_{t+1} - A x_t - B u_t."""

    x: np.ndarray
    u: np.ndarray
    h: np.ndarray
    h_hat: np.ndarray
    """The oracle's estimate before it learned this sample."""
    past: np.ndarray
    """The k - 1 pairs (x, u) before this one as the oracle saw them, (k - 1, d + m), oldest first."""
    variance: np.ndarray
    """Of h, (d,); zeros where a sample is the state."""


@dataclass(frozen=True, eq=False)
class StepResult:
    """What a step decided and found, in deviation coordinates. plan is (N, m) with plan[0] the input for now."""

    plan: np.ndarray
    mode: Mode
    solution: Solution | None
    label: Label | None
    verdict: Verdict
    """About the hidden layers on offer."""
    rolled_back: str
    """Why the hidden weights and K from before came back; empty where they did not."""
    delay: float
    """Seconds for which the sample was predicted ahead, to when the command acts."""
    first: FirstInputs | None
    """What is certified of v_0; None where there are no certified sets, or no state."""
    target: SteadyState | None
    """Where the plan aims; None without a reference: at the equilibrium."""
    weights: np.ndarray
    """What of each part of h_hat counts in the prediction, (parts, d), 0 to 1; (0, d) where nothing weighs it."""
    deviation: np.ndarray
    """Standard deviation of the state that is known, (d,); (0,) where a sample is the state."""
    sensor_faults: dict[str, str]
    """Which sensors are not believed, by the names of their states, and in words what is wrong."""
    noise: np.ndarray
    """Standard deviation of what is measured as the estimator found it, (d,); (0,) where it had not to."""

    @property
    def new_network(self) -> bool:
        """Whether other hidden layers are in use from now on."""
        return self.verdict.outcome == "adopted" or bool(self.rolled_back)
