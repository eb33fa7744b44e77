"""What to apply when there is no solution: the rest of the last plan, then the feedback K."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lbmpc.model import Model
from lbmpc.plants.rows import together


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
    model: Model,
    x: np.ndarray,
    horizon: int,
    xs: np.ndarray | float = 0.0,
    us: np.ndarray | float = 0.0,
    previous: np.ndarray | None = None,
) -> np.ndarray:
    """us + K (x - xs) brought into U, along the nominal prediction from x, (N, m); xs (d,) and us (m,): the target.

    Where inputs have rate limits, each is brought within reach of the one before, the first of `previous`, (m,).
    """
    plant, inputs = model.plant, np.zeros((horizon, model.m))
    beside = plant.input_rows.about(plant.u_e)
    for i in range(horizon):
        fed_back = np.clip(us + model.K @ (x - xs), plant.u_min - plant.u_e, plant.u_max - plant.u_e)
        inputs[i] = beside.pulled(fed_back, 0.0)
        if previous is not None:
            previous = inputs[i] = reachable(model, inputs[i], previous)
        x = model.A @ x + model.B @ inputs[i]
    return inputs


def reachable(model: Model, u: np.ndarray, previous: np.ndarray) -> np.ndarray:
    """The input nearest to u, (m,), that rate limits allow one period after `previous`, (m,).

    Where U has rows beside its box, that on the straight way from there, which keeps them.
    """
    step = model.plant.input_rates * model.period
    if model.plant.input_rows.names:
        return together(u, previous, previous - step, previous + step)
    return np.clip(u, previous - step, previous + step)


def all_reachable(model: Model, inputs: np.ndarray, previous: np.ndarray) -> np.ndarray:
    """`reachable` for one input of (N, m) after the other."""
    kept = np.empty_like(inputs)
    for i, u in enumerate(inputs):
        previous = kept[i] = reachable(model, u, previous)
    return kept
