"""The memory of a controller as data."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from lbmpc.controller.dead_time import LineState
from lbmpc.controller.fallback import Plan
from lbmpc.estimator.base import EstimatorState
from lbmpc.oracles.base import OracleState
from lbmpc.references import Reference


@dataclass(frozen=True, eq=False)
class ControllerState:
    """The complete memory of the controller. It is flat, so that a keyframe can store and restore it."""

    plan: Plan
    """Shifted solution: warm start of the next solve, and fallback."""
    pending_x: np.ndarray
    """The estimated x_t whose label is still missing, (d,)."""
    pending: tuple[int, int]
    """Its (source, sequence); sequence is -1 if no label is pending."""
    predicted: np.ndarray
    """The next state as predicted by the learned model, with the past pairs of `lbmpc.oracles.base` behind it, (D,)."""
    delay: float
    """Smoothed seconds from a sample until its command acts; the configured value before the first measurement."""
    oracle: OracleState
    target: np.ndarray
    """x and u of the last target, (d + m,), as start of the next search; (0,) without a reference."""
    estimator: EstimatorState
    commanded: np.ndarray
    """The last commanded input, (m,), or the safe one; (0,) if no plan depends on it."""
    line: LineState = field(default_factory=dict)
    """Inputs that were written and have not acted yet, see `lbmpc.controller.dead_time`; empty without a dead time."""
    reference: Reference | None = None
    """The given reference as of the next tick; None means the configured one."""

    def to_arrays(self) -> dict[str, np.ndarray]:
        return {
            "plan.u": self.plan.u,
            "plan.c": self.plan.c,
            "plan.left": np.array([self.plan.left], dtype=np.int64),
            "pending.x": self.pending_x,
            "pending": np.array(self.pending, dtype=np.int64),
            "predicted": self.predicted,
            "delay": np.array([self.delay]),
            **({"target": self.target} if self.target.size else {}),
            **({"commanded": self.commanded} if self.commanded.size else {}),
            **{f"reference.{name}": array for name, array in self._reference_arrays().items()},
            **{f"estimator.{name}": array for name, array in self.estimator.items()},
            **{f"line.{name}": array for name, array in self.line.items()},
            **{f"oracle.{name}": array for name, array in self.oracle.items()},
        }

    def _reference_arrays(self) -> dict[str, np.ndarray]:
        return {} if self.reference is None else self.reference.to_arrays()

    @classmethod
    def from_arrays(cls, arrays: dict[str, np.ndarray]) -> ControllerState:
        """Restore a state.

        Raises:
            KeyError: an array is missing.
            ValueError: the arrays of the reference are not valid.
        """
        source, sequence = (int(value) for value in arrays["pending"])
        oracle, estimator, line, reference = (
            {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}
            for prefix in ("oracle.", "estimator.", "line.", "reference.")
        )
        plan = Plan(arrays["plan.u"], arrays["plan.c"], int(arrays["plan.left"][0]))
        return cls(
            plan,
            arrays["pending.x"],
            (source, sequence),
            arrays["predicted"],
            float(arrays["delay"][0]),
            oracle,
            arrays.get("target", np.zeros(0)),
            estimator,
            arrays.get("commanded", np.zeros(0)),
            line,
            Reference.from_arrays(reference, len(arrays["pending.x"])) if reference else None,
        )
