"""The CasADi functions of the solver: a Gauss-Newton linearisation whitened by a Riccati sweep, and its sensitivities.

The inputs of the learned trajectory are u_i = v_i + K (z_i - zbar_i). At an iterate v the Gauss-Newton subproblem in
the step du is a linear-quadratic problem. Its Riccati recursion gives gains such that, with

    du_i = K_i dz_i + k_i + L_i^{-T} w_i,

the cost is a constant plus |w|^2 / 2. The constrained subproblem is then a least-distance problem in w: find the
feasible w nearest to 0, the unconstrained minimiser. `sweep` computes that minimiser. `rows` computes the dependence
of inputs and nominal states on w by

    dv_i = du_i - K (dz_i - dzbar_i),   dzbar_{i+1} = A dzbar_i + B dv_i,

so v and zbar of any step satisfy the nominal model exactly, independent of the accuracy of the linearisation of z.

No Hessian is formed, and only m x m blocks are factorised.

The rows constrain the nominal states zbar. In a backup policy (`controller.backup_policy`) they constrain the learned
states z, whose linearisation the recursion contains anyway, and u is v; see `constrained`.

For an oracle with a window, the state of the recursion is s = (x, past pairs) of `lbmpc.oracles.base`, of length D. The
cost depends on x alone, and only the d rows of x+ of the Jacobians are stored, because the rest of s+ is a shift.
Without a window s is x and D is d. If changes of the input have a cost, the previous input follows in s, so that D is
larger by m; in s+ it is u.
"""

from __future__ import annotations

from typing import Literal

import casadi as ca
import numpy as np

from lbmpc.model import Model
from lbmpc.oracles.base import Oracle, follow_symbols, remembered

Constrained = Literal["nominal", "learned"]
"""Selects the states that the rows constrain."""


def build_sweep(model: Model, oracle: Oracle, n: int, constrained: Constrained = "nominal") -> ca.Function:
    """Build (x, v, theta, xr, ur) -> (cost, vs, us, zs, A, B, K, L) for a horizon of n.

    Inputs: x (D,), which is s_0 followed by u_{-1} if changes have a cost; iterate v (m, n); theta; references xr
    (d, n + 1) and ur (m, n).
    Outputs: half of psi at v, in units of the model's `cost_scale`; the subproblem's unconstrained minimiser vs (m, n),
    the inputs us (m, n) of its learned states and its *nominal* states zbar_1..n, zs (d, n); the Jacobians along the
    learned trajectory A (d, D n), B (d, m n); gains K (m, D n) and L^{-T} (m, m n).
    With `learned`, zs are the minimiser's learned states in this linearisation; z (d, n) are those of v.
    """
    d, m, behind, before = model.d, model.m, remembered(oracle), input_before(model)
    # The cost is in units of its own scale, so that w, the penalty and the QP's tolerances are comparable for any Q, R.
    q, r, p, change = (
        ca.DM(weight / model.cost_scale) for weight in (model.Q, model.R, model.P, model.S[:before, :before])
    )
    a, b = ca.DM(model.A), ca.DM(model.B)
    x, v, theta = (
        ca.MX.sym("x", d + behind + before),
        ca.MX.sym("v", m, n),
        ca.MX.sym("theta", oracle.parameters),
    )
    xr, ur = ca.MX.sym("xr", d, n + 1), ca.MX.sym("ur", m, n)
    inputs = ca.horzsplit(v)
    parts = oracle.split(theta)

    stage = _learned_stage(model, oracle, parts)
    gain = _gain(model, constrained)
    states, applied, nominal = [x[: d + behind] if before else x], [], x[:d]
    for i in range(n):
        applied.append(inputs[i] + gain @ (states[i][:d] - nominal))
        states.append(follow_symbols(states[i], applied[i], stage(states[i], applied[i], *parts)))
        nominal = a @ nominal + b @ inputs[i]
    u = ca.horzcat(*applied)
    s = ca.horzcat(*states)
    z = s[:d, :] if behind else s
    dz, du = z - xr, u - ur
    gradient_z, gradient_v = q @ dz[:, :n], r @ du
    gradient_end = p @ dz[:, n]
    cost = 0.5 * (ca.dot(gradient_z, dz[:, :n]) + ca.dot(gradient_v, du) + ca.dot(gradient_end, dz[:, n]))
    gradient_s = gradient_z
    if before:
        changed = u - ca.horzcat(x[d + behind :], u[:, :-1])
        gradient_change = change @ changed
        cost += 0.5 * ca.dot(gradient_change, changed)
        gradient_v += gradient_change
        gradient_s = ca.vertcat(gradient_z, ca.MX.zeros(behind, n), -gradient_change)
    elif behind:
        gradient_s = ca.vertcat(gradient_z, ca.MX.zeros(behind, n))

    stages = oracle.jacobians(ca.vertcat(s[:, :n], u), parts)
    linear = ca.horzcat(a, ca.DM(d, behind)) if behind else a
    a_i = [linear + jacobian[:, : d + behind] for jacobian in stages]
    if before:
        a_i = [ca.horzcat(slopes, ca.MX.zeros(d, before)) for slopes in a_i]
    b_i = [b + jacobian[:, d + behind :] for jacobian in stages]

    longer = behind + before
    riccati = _riccati_stage_behind(d, m, behind, q, r, change) if longer else _riccati_stage(d, m, q, r)
    p_matrix, p_vector = _padded(p, longer), ca.vertcat(gradient_end, ca.DM(longer, 1))
    gains: list[ca.MX] = [ca.MX()] * n
    offsets: list[ca.MX] = [ca.MX()] * n
    inverses: list[ca.MX] = [ca.MX()] * n
    columns_s, columns_v = ca.horzsplit(gradient_s), ca.horzsplit(gradient_v)
    for i in reversed(range(n)):
        p_matrix, p_vector, gains[i], offsets[i], inverses[i] = riccati(
            p_matrix, p_vector, a_i[i], b_i[i], columns_s[i], columns_v[i]
        )

    step, nominal = ca.MX.zeros(d + longer), x[:d]
    minimiser, steered, nominal_states, learned_states = [], [], [], []
    for i in range(n):
        move = gains[i] @ step + offsets[i]
        steered.append(applied[i] + move)
        minimiser.append(steered[i] - gain @ (z[:, i] + step[:d] - nominal))
        after = a_i[i] @ step + b_i[i] @ move
        shifted = follow_symbols(step[: d + behind] if before else step, move, after)
        step = ca.vertcat(shifted, move) if before else shifted
        nominal = a @ nominal + b @ minimiser[i]
        nominal_states.append(nominal)
        learned_states.append(z[:, i + 1] + step[:d])
    blocks = {
        "vs": minimiser,
        "us": steered,
        "zs": nominal_states,
        "A": a_i,
        "B": b_i,
        "K": gains,
        "L": inverses,
    }
    if constrained == "learned":
        blocks |= {"zs": learned_states, "z": ca.horzsplit(z[:, 1:])}
    return ca.Function(
        "sweep" if constrained == "nominal" else "backup_sweep",
        [x, v, theta, xr, ur],
        [cost, *(ca.densify(ca.horzcat(*parts)) for parts in blocks.values())],
        ["x", "v", "theta", "xr", "ur"],
        ["cost", *blocks],
    )


def build_rows(model: Model, n: int, behind: int = 0, constrained: Constrained = "nominal") -> ca.Function:
    """Build (A, B, K, L) of `sweep` -> M' (m n, (m + d) n), U' (m n, m n), transposed.

    M contains the slopes of v_0..n-1 and zbar_1..n in w; U those of u_0..n-1. `behind` is D - d. With `learned`, z_1..n
    replace zbar_1..n.
    """
    return _propagation(model, n, behind, follow_state=False, constrained=constrained)


def build_tangent(model: Model, n: int, behind: int = 0) -> ca.Function:
    """Build `build_rows` with the slopes in s_0 for constant w in addition: Y' (D, (m + d) n) and X' (D, m n)."""
    return _propagation(model, n, behind, follow_state=True)


def _propagation(
    model: Model, n: int, behind: int, follow_state: bool, constrained: Constrained = "nominal"
) -> ca.Function:
    """Build forward sensitivities with one row per direction, so that the blocks of all stages are contiguous."""
    d, m, past, before = model.d, model.m, model.d + behind, input_before(model)
    length = past + before
    a, b = ca.DM(model.A).T, ca.DM(model.B).T
    a_all, b_all = ca.MX.sym("A", d, length * n), ca.MX.sym("B", d, m * n)
    k_all, l_all = ca.MX.sym("K", m, length * n), ca.MX.sym("L", m, m * n)
    a_i, b_i = ca.horzsplit(a_all, length), ca.horzsplit(b_all, m)
    k_i, l_i = ca.horzsplit(k_all, length), ca.horzsplit(l_all, m)
    # Directions: those of s_0 if requested, then all of w.
    of_state = length if follow_state else 0
    rows = of_state + m * n
    start = (
        ca.densify(ca.vertcat(ca.DM.eye(of_state), ca.DM(m * n, length)))
        if of_state
        else ca.DM.zeros(rows, length)
    )
    step, nominal = ca.MX(start), ca.MX(start[:, :d])
    gain = _gain(model, constrained).T
    moves, steered, states = [], [], []
    for i in range(n):
        # w_i acts from stage i on.
        own = ca.vertcat(ca.MX(of_state + m * i, m), l_i[i].T, ca.MX(m * (n - 1 - i), m))
        steered.append(step @ k_i[i].T + own)
        moves.append(steered[i] - (step[:, :d] - nominal) @ gain)
        after = step @ a_i[i].T + steered[i] @ b_i[i].T
        if behind:
            after = ca.horzcat(after, step[:, 2 * d + m : past], step[:, :d], steered[i])
        step = ca.horzcat(after, steered[i]) if before else after
        nominal = nominal @ a + moves[i] @ b
        states.append(nominal if constrained == "nominal" else step[:, :d])
    rows_move, inputs_move = ca.densify(ca.horzcat(*moves, *states)), ca.densify(ca.horzcat(*steered))
    outputs, names = [rows_move[of_state:, :], inputs_move[of_state:, :]], ["M", "U"]
    if of_state:
        outputs, names = [*outputs, rows_move[:of_state, :], inputs_move[:of_state, :]], [*names, "Y", "X"]
    name = "tangent" if follow_state else "rows" if constrained == "nominal" else "backup_rows"
    return ca.Function(name, [a_all, b_all, k_all, l_all], outputs, ["A", "B", "K", "L"], names)


def input_before(model: Model) -> int:
    """Return the number of entries for the previous input in the recursion's state: m if changes have a cost."""
    return model.m if model.changes_cost else 0


def with_input(model: Model, s: np.ndarray, previous: np.ndarray | None) -> np.ndarray:
    """Return x of `sweep`: s, followed by the previous input, (m,), if it matters; None means the equilibrium's."""
    before = input_before(model)
    return np.concatenate([s, np.zeros(before) if previous is None else previous]) if before else s


def _gain(model: Model, constrained: Constrained) -> ca.DM:
    """Return K, (m, d), of the learned trajectory about the nominal one; 0 without a nominal one."""
    return ca.DM(model.K) if constrained == "nominal" else ca.DM(model.m, model.d)


def _learned_stage(model: Model, oracle: Oracle, parts: list[ca.MX]) -> ca.Function:
    """Build (s, v, parts...) -> A z + B v + h_hat(s, v), with z the first d entries of s."""
    s, v = ca.MX.sym("z", model.d + remembered(oracle)), ca.MX.sym("v", model.m)
    z = s if oracle.pairs == 1 else s[: model.d]
    symbols = [ca.MX.sym(f"part{i}", *part.shape) for i, part in enumerate(parts)]
    learned = ca.DM(model.A) @ z + ca.DM(model.B) @ v + oracle.value(ca.vertcat(s, v), symbols)
    return ca.Function("stage", [s, v, *symbols], [learned])


def _riccati_stage(d: int, m: int, q: ca.DM, r: ca.DM) -> ca.Function:
    """Build one backward step: (P, p, A, B, q, r) -> (P-, p-, K, k, L^{-T})."""
    p_matrix, p_vector = ca.SX.sym("P", d, d), ca.SX.sym("p", d)
    a, b = ca.SX.sym("A", d, d), ca.SX.sym("B", d, m)
    gradient_z, gradient_v = ca.SX.sym("q", d), ca.SX.sym("r", m)
    pb = p_matrix @ b
    # ca.chol gives the upper factor U with U'U = S; L' = U.
    upper = ca.chol(r + b.T @ pb)
    inverse = ca.inv(upper)
    half = inverse.T @ (pb.T @ a)
    residual = inverse.T @ (gradient_v + b.T @ p_vector)
    gain, offset = -inverse @ half, -inverse @ residual
    previous = q + a.T @ p_matrix @ a - half.T @ half
    return ca.Function(
        "riccati",
        [p_matrix, p_vector, a, b, gradient_z, gradient_v],
        [
            0.5 * (previous + previous.T),
            gradient_z + a.T @ p_vector - half.T @ residual,
            gain,
            offset,
            inverse,
        ],
    )


def _riccati_stage_behind(d: int, m: int, behind: int, q: ca.DM, r: ca.DM, change: ca.DM) -> ca.Function:
    """Build `_riccati_stage` for s+ = (A s + B v, s without x and its oldest pair, x, v): A (d, D), B (d, m).

    If changes of the input have a cost, `change` (m, m), s ends with the previous input, and s+ with v. q is then (D,),
    as it is for an s with pairs. The shift needs no product: the transposed dynamics select rows.
    """
    past, pair, before = d + behind, d + m, change.shape[0]
    length = past + before
    p_matrix, p_vector = ca.MX.sym("P", length, length), ca.MX.sym("p", length)
    a, b = ca.MX.sym("A", d, length), ca.MX.sym("B", d, m)
    gradient_s, gradient_v = ca.MX.sym("q", length), ca.MX.sym("r", m)

    def back(rows: ca.MX) -> ca.MX:
        """Map the derivative along s+, one row per entry, to that along s."""
        derivative = a.T @ rows[:d, :]
        if behind:
            forgotten, free = ca.MX.zeros(pair, rows.shape[1]), ca.MX.zeros(before, rows.shape[1])
            newest = rows[past - pair : past - m, :]
            derivative += ca.vertcat(newest, forgotten, rows[d : past - pair, :], free)
        return derivative

    def back_input(rows: ca.MX) -> ca.MX:
        derivative = b.T @ rows[:d, :]
        if behind:
            derivative += rows[past - m : past, :]
        return derivative + rows[past:, :] if before else derivative

    pa, pb = back(p_matrix).T, back_input(p_matrix).T
    curvature, mixed, weight = r + back_input(pb), back_input(pa), q
    if before:
        curvature, mixed = curvature + change, mixed - ca.horzcat(ca.DM.zeros(m, past), change)
        weight = ca.diagcat(q, ca.DM.zeros(behind, behind), change)
    s = ca.SX.sym("S", m, m)
    # ca.chol gives the upper factor U with U'U = S; L' = U.
    inverse = ca.Function("whiten", [s], [ca.inv(ca.chol(s))])(curvature)
    half = inverse.T @ mixed
    residual = inverse.T @ (gradient_v + back_input(p_vector))
    gain, offset = -inverse @ half, -inverse @ residual
    previous = _padded(weight, length - weight.shape[0]) + back(pa) - half.T @ half
    return ca.Function(
        "riccati",
        [p_matrix, p_vector, a, b, gradient_s, gradient_v],
        [
            0.5 * (previous + previous.T),
            gradient_s + back(p_vector) - half.T @ residual,
            gain,
            offset,
            inverse,
        ],
    )


def _padded(matrix: ca.DM, behind: int) -> ca.MX:
    """Extend a weight on x to a weight on s, which is `behind` entries longer."""
    return ca.MX(ca.densify(ca.diagcat(matrix, ca.DM(behind, behind))) if behind else matrix)
