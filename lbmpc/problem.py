"""The optimisation problem of learning-based MPC, (e:LBMPC), as data.

    min over v      |z_N - x^r_N|_P^2 + sum_i |z_i - x^r_i|_Q^2 + |u_i - u^r_i|_R^2 + |u_i - u_{i-1}|_S^2
    subject to      z_{i+1}    = A z_i + B u_i + h_hat(z_i, u_i),       z_0 = x_t           (learned trajectory)
                    u_i        = v_i + K (z_i - zbar_i)
                    zbar_{i+1} = A zbar_i + B v_i,                      zbar_0 = x_t         (nominal trajectory)
                    v_i in V_i,   |v_i - v_{i-1}| <= rate T,   zbar_{i+1} in Z_{i+1}         i = 0 .. N-1

in deviation coordinates. With the paper's c_i = v_i - K zbar_i each trajectory has feedback of its own state, v_i =
K zbar_i + c_i and u_i = K z_i + c_i. The deviation of z from zbar due to h_hat thus grows with A + BK, not with A, and
zbar need not follow corrections that h_hat requires of z (docs/decisions/0033). u_0 equals v_0. Optimising over v and
over c is equivalent, but v is better conditioned. The constraints do not depend on the oracle: in v they are linear
with constant matrices. u_{-1} and v_{-1} are the present input. By default S is 0 and the rate is unlimited.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from lbmpc.model import Model, require_horizon
from lbmpc.oracles.base import Oracle
from lbmpc.sets.certificate import Certificate, CertificateError, require_match
from lbmpc.sets.constraint_sets import disturbance_set, input_set, state_set
from lbmpc.sets.geometry.polytope import EmptySetError, Polytope
from lbmpc.sets.guard import Guard
from lbmpc.sets.invariance.terminal import terminal_set
from lbmpc.sets.invariance.tube import tighten, tube_margins
from lbmpc.sets.motion import require_certifiable, require_prediction

Tightening = Literal["none", "first_step", "tube", "invariant"]


@dataclass(frozen=True, eq=False)
class Problem:
    """(e:LBMPC) for one model, oracle and horizon.

    `states[i]` bounds zbar_{i+1} and `inputs[i]` bounds v_i. State rows are soft, with the exact penalty `penalty`
    times the model's `cost_scale` per half-width of violation, unless a set guarantees feasibility. Rows of lower
    importance are relaxed first, see `priorities`.
    """

    model: Model
    oracle: Oracle
    horizon: int
    tightening: Tightening
    states: tuple[Polytope, ...]
    inputs: tuple[Polytope, ...]
    soft: bool
    penalty: float
    guard: Guard | None = None
    """Bounds v_0 by a certified family of sets; None without a certificate."""

    @cached_property
    def input_steps(self) -> np.ndarray:
        """Largest change of an input between stages, (m,); infinite without a rate limit."""
        return self.model.plant.input_rates * self.model.period

    @cached_property
    def priorities(self) -> tuple[int, ...]:
        """Priorities of the rows that all `states` share; rows with 0 are relaxed last."""
        return (0,) * self.model.d + self.model.plant.state_rows.priorities

    @cached_property
    def looks_back(self) -> bool:
        """Whether v_0 depends on the previous input."""
        return bool(self.model.changes_cost or np.isfinite(self.input_steps).any())


def build_problem(
    model: Model,
    oracle: Oracle,
    horizon: int,
    tightening: Tightening = "first_step",
    W: np.ndarray | None = None,
    penalty: float = 100.0,
    certificate: Certificate | None = None,
) -> Problem:
    """Set up the constraints of a tightening. W (d,) is a bound of h over one period.

    * `none`: plain X and U.
    * `first_step`: zbar_1 in X - W, plain X and U afterwards; state rows are soft.
    * `tube`: zbar_i in X - R_i, v_i in U - K R_i, zbar_N in Omega - R_N with Omega disturbance invariant. State rows
      are hard, because a problem that is feasible once stays feasible.
    * `invariant`: v_0 is bounded so that the next state stays in the sets of `certificate`, hard. Later rows, and all
      rows outside the sets, are those of `first_step`.

    Raises:
        ModelError: predictions grow too much over the horizon.
        EmptySetError: a tightened set is empty. The text names the step, the constraint and the margin.
        CertificateError: `invariant` without a certificate, with that of another model, with a dead time or with rows
            besides the boxes; `tube` with rows of inputs; either of them with rate limits of inputs.
    """
    require_horizon(model, horizon)
    if tightening in ("tube", "invariant"):
        _require_steps(model, tightening)
    guard = None
    if tightening == "invariant":
        require_certifiable(model)
        if certificate is None:
            raise CertificateError(
                "the tightening `invariant` needs certified sets; compute them with `tandem sets compute`"
            )
        require_match(certificate, model)
        if not certificate.certified:
            raise CertificateError(
                f"these sets are an approximation ({certificate.kind}) and are not certified"
            )
        if certificate.source_of_W == "given":
            require_prediction(model)
        guard = Guard(certificate)
    x_set, u_set, w_set = state_set(model), input_set(model), disturbance_set(model, W)
    n = horizon
    if tightening == "tube":
        closed, identity = model.closed_loop, np.eye(model.d)
        states = tighten(x_set, identity, closed, w_set, n, "state")[1:]
        inputs = tighten(u_set, model.K, closed, w_set, n - 1, "input")
        states[-1] = _terminal(model, x_set, u_set, w_set, states[-1], n)
        return Problem(model, oracle, n, tightening, tuple(states), tuple(inputs), False, penalty)
    states = [x_set] * n
    if tightening in ("first_step", "invariant"):
        low = np.array([w_set.support(-row) for row in x_set.F])
        high = np.array([w_set.support(row) for row in x_set.F])
        states[0] = x_set.minus(low, high)
        states[0].require_rows(1, "state")
    return Problem(model, oracle, n, tightening, tuple(states), (u_set,) * n, True, penalty, guard)


def _require_steps(model: Model, tightening: Tightening) -> None:
    """Raise `CertificateError` for rate limits or rows of inputs, which the guarantee of these tightenings excludes."""
    plant = model.plant
    if plant.input_rows.names and tightening == "tube":
        raise CertificateError(
            "the tightening `tube` supports boxes of inputs only, but there are rows of inputs "
            f"({', '.join(plant.input_rows.names)}): remove them, or use the tightening `first_step`"
        )
    if limited := [
        name for name, rate in zip(plant.inputs, plant.input_rates, strict=True) if np.isfinite(rate)
    ]:
        raise CertificateError(
            f"the tightening `{tightening}` guarantees X for unlimited input rates, but there are rate limits for "
            f"{', '.join(limited)}: remove plant.input_rate_max (u_rate_max of the plant), or "
            "use the tightening `first_step`, which has no guarantee"
        )


def _terminal(model: Model, X: Polytope, U: Polytope, W: Polytope, last: Polytope, n: int) -> Polytope:
    """Return the intersection of Omega - R_N and X - R_N as the rows of the last step."""
    omega = terminal_set(model, X, U, W)
    low, high = tube_margins(omega.F, model.closed_loop, W, n)
    omega = omega.minus(low[n], high[n])
    both = Polytope(
        np.vstack([last.F, omega.F]),
        np.concatenate([last.lower, omega.lower]),
        np.concatenate([last.upper, omega.upper]),
        last.names + omega.names,
    )
    if both.interior_point(model.plant.x_scale) is None:
        raise EmptySetError(
            f"the tightened set is empty at step {n}: the terminal set Omega - R_{n} is empty. "
            f"A smaller W, another K or a shorter horizon may help."
        )
    return both
