"""The result of a solve."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np


class Status(StrEnum):
    """How a solve ended. All but NUMERICAL come with inputs that satisfy every feasible constraint."""

    CONVERGED = "converged"
    ITERATION_LIMIT = "iteration limit"
    REAL_TIME = "real-time iteration"
    """One Gauss-Newton step from a linearisation that was prepared before x_t was measured."""
    INFEASIBLE = "infeasible"
    """No plan was found that satisfies all state constraints from x_t; `slack` is the violation of this plan."""
    ORACLE_REFUSED = "oracle refused"
    """The oracle's numbers could not be used; the problem was solved with the nominal model."""
    NUMERICAL = "numerical failure"
    """No usable inputs."""


@dataclass(frozen=True, eq=False)
class Solution:
    """Result of one solve, in deviation coordinates.

    v is (N, m). c (N, m) is v without K zbar_i. zbar (N, d) are the nominal states zbar_1..zbar_N. u (N, m) are the
    inputs of the learned trajectory, inside U; they are followed if no later plan arrives. u_0 is v_0. `slack` is the
    largest violation of a state row by zbar, as a share of that row's half-width, 0 if there is none, and `slack_row`
    is its name ("y at step 3").
    """

    status: Status
    v: np.ndarray
    c: np.ndarray
    u: np.ndarray
    zbar: np.ndarray
    cost: float
    iterations: int
    slack: float
    slack_row: str

    @property
    def usable(self) -> bool:
        return self.status is not Status.NUMERICAL
