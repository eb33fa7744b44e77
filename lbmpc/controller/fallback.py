"""What to apply when there is no solution: the rest of the last plan, then the feedback K."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lbmpc.model import Model


@dataclass(frozen=True, eq=False)
class Plan:
    """Inputs still to come, (N, m), deviation coordinates; the first `left` of them come from a solution.

    Behind those stands K along the nominal prediction, so that a plan is never short.
    """

    v: np.ndarray
    left: int


def empty_plan(horizon: int, m: int) -> Plan:
    """No solution yet: zeros, none of which may be followed."""
    return Plan(np.zeros((horizon, m)), 0)


def shift(plan: Plan, last: np.ndarray) -> Plan:
    """The plan one period later; `last` (m,) goes behind its end. Also the warm start of the next solve."""
    return Plan(np.concatenate([plan.v[1:], last[None]]), max(plan.left - 1, 0))


def feedback_plan(model: Model, x: np.ndarray, horizon: int) -> np.ndarray:
    """K x clipped to U, along the nominal prediction from x, (N, m)."""
    plant, inputs = model.plant, np.zeros((horizon, model.m))
    for i in range(horizon):
        inputs[i] = np.clip(model.K @ x, plant.u_min - plant.u_e, plant.u_max - plant.u_e)
        x = model.A @ x + model.B @ inputs[i]
    return inputs
