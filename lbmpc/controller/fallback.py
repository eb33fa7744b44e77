"""What to apply when there is no solution: the rest of the last plan, then the feedback K."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lbmpc.controller.signals import Mode
from lbmpc.model import Model
from lbmpc.solver.constraint_rows import Box


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


def without_solution(
    model: Model,
    plan: Plan,
    x: np.ndarray | None,
    xu: np.ndarray,
    first: Box | None,
    previous: np.ndarray | None,
) -> tuple[Plan, Mode]:
    """What is followed in this period and after it.

    Args:
        model: the nominal model.
        plan: the last one, shifted.
        x: the state when it acts, (d,); None: it is not known.
        xu: x and u of the target, (d + m,); (0,) for the equilibrium.
        first: bounds on the first input: what is certified holds without a solution too.
        previous: what acts before it, (m,), where inputs have rate limits.
    """
    if plan.left > 0:
        return _kept(model, _begun_within(plan, first), previous), "shifted_plan"
    horizon, d = len(plan.u), model.d
    nothing = empty_plan(horizon, model.m)
    xs, us = (xu[:d], xu[d:]) if xu.size else (0.0, 0.0)
    if x is None:
        # Neither a plan nor a state: the input of the target, or of the equilibrium, is all that is left.
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
    """us + K (x - xs) brought into U, along the nominal prediction from x, (N, m); xs (d,) and us (m,): the target.

    Where inputs have rate limits, each is brought within reach of the one before, the first of `previous`, (m,).
    """
    inputs = np.zeros((horizon, model.m))
    for i in range(horizon):
        inputs[i] = model.plant.within_about(us + model.K @ (x - xs))
        if previous is not None:
            previous = inputs[i] = model.plant.reachable(inputs[i], previous, model.period)
        x = model.A @ x + model.B @ inputs[i]
    return inputs


def all_reachable(model: Model, inputs: np.ndarray, previous: np.ndarray) -> np.ndarray:
    """`Description.reachable` for one input of (N, m) after the other."""
    kept = np.empty_like(inputs)
    for i, u in enumerate(inputs):
        previous = kept[i] = model.plant.reachable(u, previous, model.period)
    return kept


def _kept(model: Model, plan: Plan, previous: np.ndarray | None) -> Plan:
    """The plan within the rate limits from `previous` on."""
    return plan if previous is None else replace(plan, u=all_reachable(model, plan.u, previous))


def _begun_within(plan: Plan, first: Box | None) -> Plan:
    """The plan with its first input brought inside the bounds."""
    if first is None:
        return plan
    return replace(plan, u=np.vstack([np.clip(plan.u[:1], *first), plan.u[1:]]))
