"""What to apply when there is no solution: the rest of the last plan, then the feedback K."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lbmpc.model import Model


@dataclass(frozen=True, eq=False)
class Plan:
    """What is still to come, (N, m) each, deviation coordinates; the first `left` entries come from a solution."""

    u: np.ndarray
    """Inputs, to be followed if nothing better comes."""
    c: np.ndarray
    """The nominal inputs without K zbar_i: where the next solve starts."""
    left: int


def empty_plan(horizon: int, m: int) -> Plan:
    """No solution yet: zeros, of which none is left to be followed."""
    return Plan(np.zeros((horizon, m)), np.zeros((horizon, m)), 0)


def shift(plan: Plan) -> Plan:
    """The plan one period later. Behind its end the last input goes on, and c is 0: K along the nominal prediction."""
    c = np.concatenate([plan.c[1:], np.zeros_like(plan.c[:1])])
    return Plan(np.concatenate([plan.u[1:], plan.u[-1:]]), c, max(plan.left - 1, 0))


def feedback_plan(
    model: Model, x: np.ndarray, horizon: int, xs: np.ndarray | float = 0.0, us: np.ndarray | float = 0.0
) -> np.ndarray:
    """us + K (x - xs) clipped to U, along the nominal prediction from x, (N, m); xs (d,) and us (m,): the target."""
    plant, inputs = model.plant, np.zeros((horizon, model.m))
    for i in range(horizon):
        inputs[i] = np.clip(us + model.K @ (x - xs), plant.u_min - plant.u_e, plant.u_max - plant.u_e)
        x = model.A @ x + model.B @ inputs[i]
    return inputs
