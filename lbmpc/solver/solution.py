"""What a solve returns."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np


class Status(StrEnum):
    """How a solve ended. All but NUMERICAL come with inputs that keep every constraint that can be kept."""

    CONVERGED = "converged"
    ITERATION_LIMIT = "iteration limit"
    REAL_TIME = "real-time iteration"
    """One Gauss-Newton step from a linearisation that was prepared before x_t was known."""
    INFEASIBLE = "infeasible"
    """No plan was found that keeps all state constraints from x_t; `slack` says by how much this one breaks them."""
    ORACLE_REFUSED = "oracle refused"
    """The oracle's numbers were unusable; solved with the nominal model."""
    NUMERICAL = "numerical failure"
    """No usable inputs."""


@dataclass(frozen=True, eq=False)
class Solution:
    """Outcome of one solve, in deviation coordinates.

    v is (N, m), c (N, m) the same without K zbar_i, zbar (N, d) the nominal states zbar_1..zbar_N that it leads to, u
    (N, m) the inputs of the learned trajectory, inside U: what to apply if nothing else comes. u_0 is v_0. `slack` is
    the largest state-row violation of zbar, as a share of that row's half-width, 0 when all are kept, and `slack_row`
    names it ("y at step 3").
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
