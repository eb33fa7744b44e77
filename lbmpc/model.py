"""The nominal model: linearisation at the equilibrium, exact discretisation, feedback K and terminal cost P.

All quantities are deviations, x - x_e and u - u_e.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import solve_discrete_are

from lbmpc.plants.description import Description, PlantDefinitionError
from lbmpc.plants.equations import Plant
from lbmpc.plants.inspection import require_model
from lbmpc.plants.known import Known
from lbmpc.plants.linear_motion import LinearMotion, Pieces, balanced, discretise, within_period
from lbmpc.pole_placement import place
from lbmpc.terminal_cost import TOLERANCE, TerminalCost, shortfall, terminal_cost

SAME_PERIOD = 1e-9
"""Relative difference below which two periods are equal, because 1 / rate is rounded."""
LARGEST_GROWTH = 1e8
"""Largest growth of a prediction over the horizon. It leaves half of the 16 digits."""
MOST_DEAD_PERIODS = 50
"""Largest dead time in periods. Each period is stored and predicted in every tick, and the error grows with it."""
STABLE = 1e-9
"""A growth per step below this value is rounding."""


class ModelError(ValueError):
    """The plant and the period give no usable model."""


@dataclass(frozen=True, eq=False)
class Model:
    """The model x+ = A x + B u + h(x, u), in which only h is unknown.

    Shapes: A (d, d), B (d, m), K (m, d), P (d, d), Q (d, d), R (m, m), S (m, m).
    """

    plant: Known
    period: float
    within: LinearMotion
    """The motion within a period."""
    A: np.ndarray
    B: np.ndarray
    Q: np.ndarray
    """Weight of the states in one stage: the density times the period."""
    R: np.ndarray
    """Weight of the inputs in one stage: the density times the period."""
    S: np.ndarray
    """Weight of the change of the inputs between stages: the density on (du/dt)^2 divided by the period."""
    K: np.ndarray
    """Feedback of the tubes and of the fallback."""
    P: np.ndarray
    """Weight of the last state, see `lbmpc.terminal_cost`."""
    equations: Plant | None = None
    """The equations that `plant` is the linearisation of; None for a plant given by numbers."""

    def require_equations(self, wanted_by: str) -> Plant:
        """Return the equations. Raises `ModelError` if the plant is given by numbers alone."""
        if self.equations is None:
            raise ModelError(
                f"{wanted_by} needs the equations of {self.plant.name}, but this plant is given by numbers alone"
            )
        return self.equations

    @property
    def d(self) -> int:
        return self.A.shape[0]

    @property
    def m(self) -> int:
        return self.B.shape[1]

    @property
    def closed_loop(self) -> np.ndarray:
        """A + BK, Schur stable."""
        return self.A + self.B @ self.K

    @cached_property
    def changes_cost(self) -> bool:
        """Whether S is not zero."""
        return bool(self.S.any())

    @cached_property
    def time_scale(self) -> float:
        """Slowest time constant of A + BK in seconds, rounded to a power of two.

        It scales h: a value that is large for a plant with time constants of milliseconds is small for one of minutes.
        Rounding keeps it constant under small changes of the weights.
        """
        slowest = max(float(np.abs(np.linalg.eigvals(self.closed_loop)).max()), 1e-300)
        return float(np.exp2(np.rint(np.log2(-self.period / math.log(slowest)))))

    @cached_property
    def cost_scale(self) -> float:
        """The unit of the cost: x'|P|x + u'Ru with every state and input at its half-width.

        It bounds the cost to go from anywhere in X, plus one input at the end of its range.
        """
        x, u = self.plant.x_scale, self.plant.u_scale
        return float(x @ np.abs(self.P) @ x + u @ self.R @ u)

    def label(self, x: np.ndarray, u: np.ndarray, x_next: np.ndarray, pieces: Pieces = ()) -> np.ndarray:
        """Return h(x_t, u_t) = x_{t+1} - A x_t - B u_t, (d,), for the input that was applied.

        If several inputs acted within the period, `pieces` lists them, and the linear model's response to them replaces
        B u_t. The mean input is accurate enough for a slow plant. With an actuator faster than the period it would
        count the timing of the command as a disturbance.
        """
        if not pieces:
            return x_next - self.step(x, u)
        return x_next - self.A.dot(x) - self.within.answer(pieces)

    def step(self, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Return A x + B u, (d,)."""
        # `dot` takes half the time of `@` on such small arrays.
        return self.A.dot(x) + self.B.dot(u)

    def ahead(self, x: np.ndarray, u: np.ndarray, seconds: float) -> np.ndarray:
        """Return the linear model's state, (d,), `seconds` after x, (d,), under u, (m,). Fast enough for every tick."""
        return self.within.after(x, u, seconds)


def build_model(
    plant: Known | Plant,
    period: float,
    Q: np.ndarray | None = None,
    R: np.ndarray | None = None,
    terminal: TerminalCost = "riccati",
    S: np.ndarray | None = None,
) -> Model:
    """Build the model for a sampling period T.

    K places the plant's configured closed-loop poles, mapped by exp(p T). Without configured poles it is the LQR gain.

    Args:
        plant: numbers, or equations that are linearised.
        period: T in seconds.
        Q, R: diagonals of the weights as densities, per second, (d,) and (m,); ones by default. A stage has T times the
            density, so that the cost of a motion does not depend on the sampling rate.
        terminal: the equation for P.
        S: diagonal of the weight on (du/dt)^2 as a density, (m,); zeros by default. A stage has
            T ((u_i - u_{i-1}) / T)^2 of it, so that a ramp has the same cost at any sampling rate. P ignores S.

    Raises:
        ModelError: the plant is not usable as described, it is not stabilisable, weights have the wrong length, or no P
            bounds the cost after the horizon.
    """
    try:
        require_model(plant)
    except PlantDefinitionError as error:
        raise ModelError(str(error)) from error
    known = plant if isinstance(plant, Known) else plant.known()
    if known.dead_time > (MOST_DEAD_PERIODS + SAME_PERIOD) * period:
        raise ModelError(
            f"{plant.name}: its dead time of {known.dead_time:g} s is {known.dead_time / period:.4g} periods; at most "
            f"{MOST_DEAD_PERIODS} are allowed: use a rate of {MOST_DEAD_PERIODS / known.dead_time:.3g} Hz or less"
        )
    units = balanced(known)
    A, B = _of_a_period(known, period, units)
    q, r = period * _weights("Q", Q, plant.d), period * _weights("R", R, plant.m)
    s = _weights("S", np.zeros(plant.m) if S is None else S, plant.m) / period
    x, u = units[: plant.d], units[plant.d :]
    a, b = A * x / x[:, None], B * u / x[:, None]
    k, p = _gain_and_terminal_weight(plant, period, terminal, a, b, np.diag(q * x**2), np.diag(r * u**2), x)
    gain, terminal_weight = k * u[:, None] / x, p / np.outer(x, x)
    equations = plant if isinstance(plant, Plant) else None
    within = within_period(known, period)
    weights = np.diag(q), np.diag(r), np.diag(s)
    return Model(known, period, within, A, B, *weights, gain, terminal_weight, equations)


def _of_a_period(known: Known, period: float, units: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return A and B for this period. Raises `ModelError` if they are given for another one."""
    if known.period is None:
        return discretise(known.A, known.B, period, units)
    if not math.isclose(known.period, period, rel_tol=SAME_PERIOD):
        raise ModelError(
            f"{known.name}: A and B are given for a period of {known.period:g} s, but the rate gives {period:g} "
            f"s: set rate = {1 / known.period:.10g}, or give A and B in continuous time"
        )
    return known.A, known.B


def _gain_and_terminal_weight(
    plant: Description,
    period: float,
    terminal: TerminalCost,
    a: np.ndarray,
    b: np.ndarray,
    q: np.ndarray,
    r: np.ndarray,
    x: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return K and P in the units x, (d,). Raises `ModelError`."""
    try:
        if plant.poles is not None:
            k = place(a, b, [_real(np.exp(p * period)) for p in plant.poles])
        else:
            s = solve_discrete_are(a, b, q, r)
            k = -np.linalg.solve(r + b.T @ s @ b, b.T @ s @ a)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise ModelError(f"{plant.name}: no stabilising K at a period of {period} s: {error}") from error
    closed = a + b @ k
    radius = float(np.abs(np.linalg.eigvals(closed)).max())
    if radius >= 1.0:
        raise ModelError(
            f"{plant.name}: A + BK is not Schur stable at a period of {period} s (radius {radius:.4f})"
        )
    return k, _terminal_weight(plant, period, terminal, a, b, q, r, k, plant.x_scale / x)


def _terminal_weight(
    plant: Description,
    period: float,
    kind: TerminalCost,
    a: np.ndarray,
    b: np.ndarray,
    q: np.ndarray,
    r: np.ndarray,
    k: np.ndarray,
    scale: np.ndarray,
) -> np.ndarray:
    """Return P of this kind after checking that it bounds the cost after the horizon. Raises `ModelError`."""
    where = f"{plant.name}: the terminal cost {kind!r} at a period of {period:g} s"
    remedy = (
        f"use {'lyapunov' if kind == 'riccati' else 'riccati'!r} (controller.terminal) or a shorter period"
    )
    try:
        p, k_f = terminal_cost(kind, a, b, q, r, k, period)
        missing = shortfall(p, k_f, a, b, q, r, scale)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise ModelError(f"{where} has no solution: {error}; {remedy}") from error
    if not missing <= TOLERANCE:
        raise ModelError(
            f"{where} does not bound the cost after the horizon: P - A_f'P A_f is smaller than Q + K_f'R K_f by "
            f"{missing:.2g} of P; {remedy}"
        )
    return p


def growth_rate(model: Model) -> float:
    """Return the growth of the fastest mode per step, the logarithm of the largest |eigenvalue| of A; at least 0."""
    return math.log(max(float(np.abs(np.linalg.eigvals(model.A)).max()), 1.0))


def longest_horizon(model: Model) -> int | None:
    """Return the horizon in steps over which a prediction grows by `LARGEST_GROWTH`; None if there is no limit."""
    rate = growth_rate(model)
    return int(math.log(LARGEST_GROWTH) / rate) if rate > STABLE else None


def require_horizon(model: Model, horizon: int) -> None:
    """Raise `ModelError` if predictions over the horizon grow so much that no digits are left."""
    rate, most = growth_rate(model), longest_horizon(model)
    if most is None or horizon <= most:
        return
    remedy = (
        f"at most {most} steps ({most * model.period:.3g} s)"
        if most
        else "no horizon at this rate; use a higher rate"
    )
    raise ModelError(
        f"{model.plant.name} is unstable: over a horizon of {horizon} steps ({horizon * model.period:.3g} s) a "
        f"prediction grows by 10^{horizon * rate / math.log(10.0):.1f}, and above "
        f"10^{math.log10(LARGEST_GROWTH):g} rounding dominates. Possible: {remedy}"
    )


def _weights(name: str, given: np.ndarray | None, length: int) -> np.ndarray:
    weights = np.ones(length) if given is None else np.asarray(given, dtype=float)
    if weights.shape != (length,):
        raise ModelError(f"{name} has {weights.size} weights, the plant needs {length}")
    return weights


def _real(value: complex) -> complex | float:
    return value.real if abs(value.imag) < 1e-15 else value
