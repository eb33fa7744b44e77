"""The Gauss-Newton subproblem: the quadratic model of the cost at an iterate, and its minimiser under the rows."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite

import numpy as np

from lbmpc.casadi_buffers import Bound
from lbmpc.solver.constraint_rows import Rows


@dataclass(frozen=True, eq=False)
class Target:
    """The result of one Gauss-Newton step."""

    v: np.ndarray
    """Inputs, (N, m)."""
    u: np.ndarray
    """Inputs of the learned trajectory, (N, m)."""
    values: np.ndarray
    """Row values, (rows,)."""
    feasible: bool
    """Whether the hard state rows are feasible."""
    seen: np.ndarray
    """Indices of the rows in the QP."""


class Subproblem:
    """The subproblem, linearised at successive iterates.

    Args:
        sweep: `riccati.build_sweep` for the states that the rows constrain.
        move: `riccati.build_rows` for the same states; the sweeps of two oracles may share it.
    """

    def __init__(self, sweep: Bound, move: Bound):
        self.sweep, self._move = sweep, move

    @property
    def free(self) -> np.ndarray:
        """The unconstrained minimiser's inputs, (N, m), valid until the next linearisation."""
        return self.sweep.outputs["vs"].T

    @property
    def steered(self) -> np.ndarray:
        """The inputs of its learned trajectory, (N, m), valid until the next linearisation."""
        return self.sweep.outputs["us"].T

    def load(
        self, x: np.ndarray, theta: np.ndarray, xr: np.ndarray | None = None, ur: np.ndarray | None = None
    ) -> None:
        """Set the initial state, (D,), the oracle's parameters and the references."""
        inputs = self.sweep.inputs
        inputs["x"][:, 0], inputs["theta"][:, 0] = x, theta
        inputs["xr"][:] = 0.0 if xr is None else np.asarray(xr).T
        inputs["ur"][:] = 0.0 if ur is None else np.asarray(ur).T

    def linearise(self, v: np.ndarray) -> float:
        """Linearise at v, (N, m), and return its true cost without soft constraints, in units of `cost_scale`."""
        self.sweep.inputs["v"][:] = v.T
        self.sweep()
        return float(self.sweep.outputs["cost"][0, 0])

    def values(self, rows: Rows) -> np.ndarray:
        """Return the row values, (rows,), at w = 0, the unconstrained minimiser."""
        return rows.values(self.sweep.outputs["vs"], self.sweep.outputs["zs"])

    def propagate(self, function: Bound) -> dict[str, np.ndarray]:
        """Evaluate `riccati.build_rows` or `build_tangent` for this linearisation."""
        for name in "ABKL":
            function.inputs[name][:] = self.sweep.outputs[name]
        function()
        return function.outputs

    def constrained(self, rows: Rows, values: np.ndarray, hint: np.ndarray) -> Target | None:
        """Return the minimiser under the rows, given their `values` at w = 0; None if the numbers are not finite.

        `hint` as for `least_distance`.
        """
        moved, free = self.propagate(self._move), self.free
        slopes = moved["M"].T
        nearest, feasible = rows.nearest(values, rows.apply(slopes), hint)
        if nearest is None:
            return None
        v = free + (slopes[: free.size] @ nearest.w).reshape(free.shape)
        u = self.steered + (moved["U"].T @ nearest.w).reshape(free.shape)
        return Target(rows.clip(v), u, nearest.values, feasible, nearest.shown.seen)


def finite(values: np.ndarray) -> bool:
    """Return whether all values are finite and none exceeds 1e150, which holds if their sum of squares is finite."""
    flat = values.ravel(order="K")
    return isfinite(flat.dot(flat))
