"""Two compiled calls: the nominal trajectory of given inputs with its row values, and the inputs for a given c.

Every solve ends with the first. In a fast loop, the equivalent dozen numpy operations would take longer than the rest
of the feedback step.
"""

from __future__ import annotations

from itertools import pairwise

import casadi as ca
import numpy as np

from lbmpc.problem import Problem


def build_nominal(problem: Problem) -> ca.Function:
    """Build (x, v, lower, upper) -> (zbar, c, values, outside, total) for x_t = x (d,) and inputs v (m, n).

    zbar (d, n) are the nominal states zbar_1..n. c (m, n) is v_i - K zbar_i. values (rows,) are those of the rows of
    `constraint_rows`. outside (rows,) is the violation of each row, 0 within its bounds. total is the sum of all
    values, which is finite if all of them are.
    """
    model, n = problem.model, problem.horizon
    a, b = ca.DM(model.A), ca.DM(model.B)
    x, v = ca.MX.sym("x", model.d), ca.MX.sym("v", model.m, n)
    states, inputs = [x], ca.horzsplit(v)
    for entry in inputs:
        states.append(a @ states[-1] + b @ entry)
    of_inputs, of_states = problem.inputs[0], problem.states[0]
    blocks = [entry if of_inputs.is_box else ca.DM(of_inputs.F) @ entry for entry in inputs]
    if limited := np.flatnonzero(np.isfinite(problem.input_steps)).tolist():
        blocks += [(entry - before)[limited] for before, entry in pairwise(inputs)]
    blocks += [state if of_states.is_box else ca.DM(of_states.F) @ state for state in states[1:]]
    # The last step can have the rows of a terminal set in addition to the common rows.
    if len(terminal := problem.states[-1].F[len(of_states.F) :]):
        blocks.append(ca.DM(terminal) @ states[-1])
    values, c = ca.vertcat(*blocks), v - ca.DM(model.K) @ ca.horzcat(*states[:-1])
    lower, upper = ca.MX.sym("lower", *values.shape), ca.MX.sym("upper", *values.shape)
    outside = ca.fmax(ca.fmax(lower - values, values - upper), 0)
    return ca.Function(
        "nominal",
        [x, v, lower, upper],
        [ca.horzcat(*states[1:]), c, values, outside, ca.sum1(values)],
        ["x", "v", "lower", "upper"],
        ["zbar", "c", "values", "outside", "total"],
    )


def build_start(problem: Problem) -> ca.Function:
    """Build (x, c, lower, upper) -> v: inputs K zbar_i + c_i, (m, n), clipped one after the other.

    `lower` and `upper`, (m,), are the bounds of v_0 under rate limits. Without rate limits the caller clips v_0. An
    earlier plan in this form stays near its own trajectory when it starts from an unexpected state.
    """
    model, n = problem.model, problem.horizon
    a, b, gain = ca.DM(model.A), ca.DM(model.B), ca.DM(model.K)
    x, c = ca.MX.sym("x", model.d), ca.MX.sym("c", model.m, n)
    lower, upper, steps = ca.MX.sym("lower", model.m), ca.MX.sym("upper", model.m), problem.input_steps
    state, inputs = x, list[ca.MX]()
    for entry, bounds in zip(ca.horzsplit(c), problem.inputs, strict=True):
        low, high = bounds.lower[: model.m], bounds.upper[: model.m]
        if np.isfinite(steps).any():
            low = ca.fmax(low, inputs[-1] - steps) if inputs else lower
            high = ca.fmin(high, inputs[-1] + steps) if inputs else upper
        inputs.append(ca.fmin(ca.fmax(gain @ state + entry, low), high))
        state = a @ state + b @ inputs[-1]
    names = ["x", "c", "lower", "upper"]
    return ca.Function("start", [x, c, lower, upper], [ca.horzcat(*inputs)], names, ["v"])
