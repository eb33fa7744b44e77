"""Inputs for a tick without a solution: the rest of the last plan, then the feedback K."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lbmpc.controller.signals import Mode
from lbmpc.model import Model
from lbmpc.solver.constraint_rows import Box


@dataclass(frozen=True, eq=False)
class Plan:
    """The remaining plan, (N, m) each, in deviations. The first `left` entries come from a solution."""

    u: np.ndarray
    """Inputs to follow until there is a newer plan."""
    c: np.ndarray
    """Nominal inputs without K zbar_i, as start of the next solve."""
    left: int


def empty_plan(horizon: int, m: int) -> Plan:
    """Return the plan before the first solution: zeros, with no entry left to follow."""
    return Plan(np.zeros((horizon, m)), np.zeros((horizon, m)), 0)


def shift(plan: Plan) -> Plan:
    """Return the plan one period later. The last input is held at its end, and c is 0 there, which means feedback K."""
    c = np.concatenate([plan.c[1:], np.zeros_like(plan.c[:1])])
    return Plan(np.concatenate([plan.u[1:], plan.u[-1:]]), c, max(plan.left - 1, 0))


def without_solution(
    model: Model,
    plan: Plan,
    x: np.ndarray | None,
    xu: np.ndarray,
    first: Box | None,
    previous: np.ndarray | None,
) -> tuple[Plan, Mode]:
    """Return the inputs to follow from this period on, and their mode.

    Args:
        model: the nominal model.
        plan: the last plan, shifted.
        x: state at the time the input acts, (d,); None if it is not known.
        xu: x and u of the target, (d + m,); (0,) for the equilibrium.
        first: bounds on the first input. The certificate also holds without a solution.
        previous: the input before it, (m,), if inputs have rate limits.
    """
    if plan.left > 0:
        return _kept(model, _begun_within(plan, first), previous), "shifted_plan"
    horizon, d = len(plan.u), model.d
    nothing = empty_plan(horizon, model.m)
    xs, us = (xu[:d], xu[d:]) if xu.size else (0.0, 0.0)
    if x is None:
        # Neither a plan nor a state is known: apply the input of the target or of the equilibrium.
        return _kept(model, replace(nothing, u=nothing.u + us), previous), "feedback"
    fed_back = replace(nothing, u=feedback_plan(model, x, horizon, xs, us, previous))
    return _begun_within(fed_back, first), "feedback"


def feedback_plan(
    model: Model,
    x: np.ndarray,
    horizon: int,
    xs: np.ndarray | float = 0.0,
    us: np.ndarray | float = 0.0,
    previous: np.ndarray | None = None,
) -> np.ndarray:
    """Return us + K (x - xs) clipped to U along the nominal prediction from x, (N, m).

    xs (d,) and us (m,) are the target. With rate limits each input is brought within reach of the one before;
    `previous`, (m,), precedes the first.
    """
    inputs = np.zeros((horizon, model.m))
    for i in range(horizon):
        inputs[i] = model.plant.within_about(us + model.K @ (x - xs))
        if previous is not None:
            previous = inputs[i] = model.plant.reachable(inputs[i], previous, model.period)
        x = model.A @ x + model.B @ inputs[i]
    return inputs


def all_reachable(model: Model, inputs: np.ndarray, previous: np.ndarray) -> np.ndarray:
    """Apply `Description.reachable` to the rows of (N, m) in turn."""
    kept = np.empty_like(inputs)
    for i, u in enumerate(inputs):
        previous = kept[i] = model.plant.reachable(u, previous, model.period)
    return kept


def _kept(model: Model, plan: Plan, previous: np.ndarray | None) -> Plan:
    """Return the plan within the rate limits, starting from `previous`."""
    return plan if previous is None else replace(plan, u=all_reachable(model, plan.u, previous))


def _begun_within(plan: Plan, first: Box | None) -> Plan:
    """Return the plan with its first input clipped to the bounds."""
    if first is None:
        return plan
    return replace(plan, u=np.vstack([np.clip(plan.u[:1], *first), plan.u[1:]]))
