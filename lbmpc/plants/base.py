"""What a plant is: its equations, its equilibrium, its constraints, and its true motion.

Bring your own plant as one file beside this one: give `rhs` in CasADi operations and fill in a `Plant`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from scipy.integrate import DOP853

from lbmpc.bound import Bound


class PlantError(ArithmeticError):
    """The plant's true equations cannot be followed any further; the text says why and where."""


@dataclass(frozen=True)
class Domain:
    """A state that must stay positive for the equations to mean anything."""

    state: int
    name: str
    unit: str


@dataclass(frozen=True, eq=False)
class Plant:
    """A continuous-time plant dx/dt = f(x, u) with box constraints, in its own units.

    Shapes: d states, m inputs; `x_*` are (d,), `u_*` are (m,), `W` is (d,).
    """

    name: str
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    units: dict[str, str]
    """Unit of every state, input and of time, by name."""
    rhs: Callable[[Any, Any], list[Any]]
    """f(x, u) written with CasADi operations; x and u are indexable."""
    x_e: np.ndarray
    """Equilibrium about which the model is linearised."""
    u_e: np.ndarray
    x_min: np.ndarray
    x_max: np.ndarray
    u_min: np.ndarray
    u_max: np.ndarray
    W: np.ndarray
    """Half-widths of the disturbance box used for tightening by default, per second of sampling period."""
    x0: np.ndarray
    safe_input: np.ndarray
    """What the plant's own hardware applies when nobody commands it."""
    performance: tuple[int, ...]
    """States that make up the reported cost; the first is the one whose overshoot is reported."""
    kernel: tuple[str, ...]
    """States and inputs that the L2NW kernel sees."""
    poles: tuple[complex, ...] | None = None
    """Continuous-time closed-loop poles for K; None: LQR with the controller's Q and R."""
    positive: tuple[Domain, ...] = ()

    @property
    def d(self) -> int:
        return len(self.states)

    @property
    def m(self) -> int:
        return len(self.inputs)

    def function(self) -> ca.Function:
        """f as a CasADi function (x, u) -> dx/dt."""
        x, u = ca.SX.sym("x", self.d), ca.SX.sym("u", self.m)
        return ca.Function("f", [x, u], [ca.vertcat(*self.rhs(x, u))], ["x", "u"], ["dx"])


class Truth:
    """The plant's true motion, integrated to a local error below 1e-9 over a sampling period.

    DOP853 (order 8, scipy) at rtol = atol = 1e-12. Deterministic: the same numbers in, the same numbers out.
    """

    def __init__(self, plant: Plant):
        self.plant = plant
        self._f = Bound(plant.function())

    def step(self, x: np.ndarray, u: np.ndarray, dt: float) -> np.ndarray:
        """x(t + dt) from x(t) = x, (d,), under the constant input u, (m,).

        Raises:
            PlantError: a state that must stay positive does not, or the numbers are not finite.
        """
        self._check(x)
        self._f.inputs["u"][:, 0] = u
        if dt <= 0.0:
            return np.array(x, dtype=float)
        solver = DOP853(self._rhs, 0.0, np.asarray(x, dtype=float), dt, rtol=1e-12, atol=1e-12)
        while solver.status == "running":
            trouble = solver.step()
            if trouble:
                raise PlantError(
                    f"{self.plant.name}: the equations of motion cannot be integrated: {trouble}"
                )
        self._check(solver.y)
        return solver.y

    def _rhs(self, _t: float, x: np.ndarray) -> np.ndarray:
        inside = self._f.inputs["x"][:, 0]
        inside[:] = x
        for domain in self.plant.positive:
            # A trial stage may leave the domain where the true motion does not; what is accepted is checked.
            inside[domain.state] = max(inside[domain.state], 1e-12)
        self._f()
        dx = self._f.outputs["dx"][:, 0]
        if not np.isfinite(dx).all():
            self._check(x)
            raise PlantError(f"{self.plant.name}: dx/dt is not finite at x = {x.tolist()}")
        return dx.copy()

    def _check(self, x: np.ndarray) -> None:
        for domain in self.plant.positive:
            value = float(x[domain.state])
            if not value > 0.0:
                raise PlantError(
                    f"{self.plant.name}: {domain.name} is {value:.6g} {domain.unit}; its equations hold for positive "
                    f"values only. The plant has left every state from which it can be controlled."
                )
        if not np.isfinite(x).all():
            raise PlantError(f"{self.plant.name}: the state is not finite: {np.asarray(x).tolist()}")
