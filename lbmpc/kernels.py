"""The two CasADi functions inside the solver: one Gauss-Newton linearisation, whitened by a Riccati sweep.

At an iterate v the Gauss-Newton subproblem in the step dv is a linear-quadratic problem. Its Riccati recursion gives
gains such that, with

    dv_i = K_i dz_i + k_i + L_i^{-T} w_i,

the cost is a constant plus |w|^2 / 2. The constrained subproblem is then a least-distance problem in w: as close to
w = 0, the unconstrained minimiser, as the rows allow. `sweep` finds that minimiser; `rows` says how the inputs and
the nominal states move with w. No Hessian is formed and nothing is factorised but m x m blocks.
"""

from __future__ import annotations

import casadi as ca

from lbmpc.model import Model
from lbmpc.oracles.base import Oracle


def build_sweep(model: Model, oracle: Oracle, n: int) -> ca.Function:
    """(x, v, theta, xr, ur) -> (cost, vs, zs, A, B, K, L) for a horizon of n.

    Inputs: x (d,), iterate v (m, n), theta, references xr (d, n + 1) and ur (m, n).
    Outputs: half of psi at v; the subproblem's unconstrained minimiser vs (m, n) and its *nominal* states zbar_1..n, zs
    (d, n); the Jacobians along the learned trajectory A (d, d n), B (d, m n); gains K (m, d n) and L^{-T} (m, m n).
    """
    d, m = model.d, model.m
    a, b, q, r = (ca.DM(matrix) for matrix in (model.A, model.B, model.Q, model.R))
    x, v, theta = ca.MX.sym("x", d), ca.MX.sym("v", m, n), ca.MX.sym("theta", oracle.parameters)
    xr, ur = ca.MX.sym("xr", d, n + 1), ca.MX.sym("ur", m, n)
    inputs = ca.horzsplit(v)
    parts = oracle.split(theta)

    stage = _learned_stage(model, oracle, parts)
    states = [x]
    for i in range(n):
        states.append(stage(states[i], inputs[i], *parts))
    z = ca.horzcat(*states)
    dz, dv = z - xr, v - ur
    gradient_z, gradient_v = q @ dz[:, :n], r @ dv
    gradient_end = ca.DM(model.P) @ dz[:, n]
    cost = 0.5 * (ca.dot(gradient_z, dz[:, :n]) + ca.dot(gradient_v, dv) + ca.dot(gradient_end, dz[:, n]))

    slopes = oracle.jacobian(ca.vertcat(z[:, :n], v), parts)
    # Column i of the k-th slope is the k-th column of the Jacobian at stage i.
    stages = [
        ca.horzcat(*columns) for columns in zip(*(ca.horzsplit(slope) for slope in slopes), strict=True)
    ]
    a_i = [a + stage_slope[:, :d] for stage_slope in stages]
    b_i = [b + stage_slope[:, d:] for stage_slope in stages]

    riccati = _riccati_stage(d, m, q, r)
    p_matrix, p_vector = ca.MX(ca.DM(model.P)), gradient_end
    gains: list[ca.MX] = [ca.MX()] * n
    offsets: list[ca.MX] = [ca.MX()] * n
    inverses: list[ca.MX] = [ca.MX()] * n
    columns_z, columns_v = ca.horzsplit(gradient_z), ca.horzsplit(gradient_v)
    for i in reversed(range(n)):
        p_matrix, p_vector, gains[i], offsets[i], inverses[i] = riccati(
            p_matrix, p_vector, a_i[i], b_i[i], columns_z[i], columns_v[i]
        )

    step, nominal, minimiser, nominal_states = ca.MX.zeros(d), x, [], []
    for i in range(n):
        move = gains[i] @ step + offsets[i]
        step = a_i[i] @ step + b_i[i] @ move
        minimiser.append(inputs[i] + move)
        nominal = a @ nominal + b @ minimiser[i]
        nominal_states.append(nominal)
    return ca.Function(
        "sweep",
        [x, v, theta, xr, ur],
        [
            cost,
            *(
                ca.densify(ca.horzcat(*blocks))
                for blocks in (minimiser, nominal_states, a_i, b_i, gains, inverses)
            ),
        ],
        ["x", "v", "theta", "xr", "ur"],
        ["cost", "vs", "zs", "A", "B", "K", "L"],
    )


def build_rows(model: Model, n: int) -> ca.Function:
    """(A, B, K, L) of `sweep` -> M' (m n, (m + d) n): how v_0..n-1, then zbar_1..n, move with w; transposed."""
    return _propagation(model, n, follow_state=False)


def build_tangent(model: Model, n: int) -> ca.Function:
    """`build_rows`, and besides Y' (d, (m + d) n): how v_0..n-1, then zbar_1..n, follow x when w stays."""
    return _propagation(model, n, follow_state=True)


def _propagation(model: Model, n: int, follow_state: bool) -> ca.Function:
    """Forward sensitivities, one row a direction: the blocks of all stages then lie side by side in memory."""
    d, m = model.d, model.m
    a, b = ca.DM(model.A).T, ca.DM(model.B).T
    a_all, b_all = ca.MX.sym("A", d, d * n), ca.MX.sym("B", d, m * n)
    k_all, l_all = ca.MX.sym("K", m, d * n), ca.MX.sym("L", m, m * n)
    a_i, b_i = ca.horzsplit(a_all, d), ca.horzsplit(b_all, m)
    k_i, l_i = ca.horzsplit(k_all, d), ca.horzsplit(l_all, m)
    # Directions: those of x, where they are followed, then all of w.
    before = d if follow_state else 0
    rows = before + m * n
    step = nominal = (
        ca.densify(ca.vertcat(ca.DM.eye(before), ca.DM(m * n, d))) if before else ca.DM.zeros(rows, d)
    )
    step, nominal = ca.MX(step), ca.MX(nominal)
    moves, states = [], []
    for i in range(n):
        # w_i begins to act at stage i.
        own = ca.vertcat(ca.MX(before + m * i, m), l_i[i].T, ca.MX(m * (n - 1 - i), m))
        move = step @ k_i[i].T + own
        step = step @ a_i[i].T + move @ b_i[i].T
        nominal = nominal @ a + move @ b
        moves.append(move)
        states.append(nominal)
    everything = ca.densify(ca.horzcat(*moves, *states))
    outputs, names = (
        ([everything[:before, :], everything[before:, :]], ["Y", "M"]) if before else ([everything], ["M"])
    )
    name = "tangent" if follow_state else "rows"
    return ca.Function(name, [a_all, b_all, k_all, l_all], outputs, ["A", "B", "K", "L"], names)


def _learned_stage(model: Model, oracle: Oracle, parts: list[ca.MX]) -> ca.Function:
    """(z, v, parts...) -> A z + B v + h_hat(z, v)."""
    z, v = ca.MX.sym("z", model.d), ca.MX.sym("v", model.m)
    symbols = [ca.MX.sym(f"part{i}", *part.shape) for i, part in enumerate(parts)]
    learned = ca.DM(model.A) @ z + ca.DM(model.B) @ v + oracle.value(ca.vertcat(z, v), symbols)
    return ca.Function("stage", [z, v, *symbols], [learned])


def _riccati_stage(d: int, m: int, q: ca.DM, r: ca.DM) -> ca.Function:
    """One step back: (P, p, A, B, q, r) -> (P-, p-, K, k, L^{-T})."""
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
