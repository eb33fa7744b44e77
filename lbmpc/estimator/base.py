"""The contract of an estimator, and the one that believes every sample.

An estimator is pure. All of its memory is a flat dictionary of arrays, as an oracle's is, ready for a keyframe.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import NamedTuple

import numpy as np

from lbmpc.plants.linear_motion import Pieces

EstimatorState = dict[str, np.ndarray]

LAST = 2**63 - 1
"""Number of a sample, as 64 bits with a sign hold it."""


class Measured(NamedTuple):
    """One sample as it came, in deviation coordinates."""

    y: np.ndarray
    """(d,); entries of states that are not measured count nothing."""
    source: int
    sequence: int
    """Its number among those of its source."""
    applied: np.ndarray | None
    """Mean input of the period that ended with it, (m,); None where that is not known."""
    pieces: Pieces
    """The inputs of that period where there were several."""


class Estimate(NamedTuple):
    """What is known once a sample is there, in deviation coordinates."""

    x: np.ndarray
    """The state at the sample, (d,)."""
    reached: np.ndarray
    """The state, (d,), whose distance from A x + B u, x the estimate before, is that one's label."""
    variance: np.ndarray
    """Of that label, (d,), units of h squared; zeros where a sample is the state."""
    innovation: np.ndarray
    """What was measured less what was predicted, (d,); NaN where either is missing."""
    innovation_variance: np.ndarray
    """What the innovation's would be if all is as the estimator takes it, (d,); NaN likewise."""


class Estimator(ABC):
    """The state from what is measured."""

    sees_all: bool
    """Whether every state is measured."""

    @abstractmethod
    def update(self, state: EstimatorState, seen: Measured) -> tuple[EstimatorState, Estimate]:
        """The memory and the estimate after one more sample."""

    def initial_state(self) -> EstimatorState:
        """The memory before the first sample."""
        return {}

    def found_noise(self, state: EstimatorState) -> np.ndarray:
        """Standard deviation of what is measured, (d,), in units of the states, 0 of others; (0,) where nobody had to
        find it."""
        return np.zeros(0)

    def tells(self, y: np.ndarray) -> bool:
        """Whether a sample, (d,), NaN where there is no number, says anything."""
        return bool(np.isfinite(y).all())

    def faults(self, state: EstimatorState) -> dict[str, str]:
        """Which sensors are not believed, by the names of their states, and in words what is wrong."""
        return {}

    def deviation(self, state: EstimatorState) -> np.ndarray:
        """Standard deviation of the state that is known, (d,), in its units; (0,) where a sample is the state."""
        return np.zeros(0)

    def missed(self, state: EstimatorState, delay: float) -> EstimatorState:
        """The memory after a period without a sample, with so many seconds from one to its command."""
        return state

    def commanded(self, state: EstimatorState, u: np.ndarray) -> EstimatorState:
        """The memory once an input, (m,), is on its way: a sample that is missing says nothing of what acted."""
        return state


class Samples(Estimator):
    """A sample is the state. It remembers nothing."""

    sees_all = True

    def __init__(self, d: int):
        self._exact, self._none = np.zeros(d), np.full(d, np.nan)

    def update(self, state: EstimatorState, seen: Measured) -> tuple[EstimatorState, Estimate]:
        return state, Estimate(seen.y, seen.y, self._exact, self._none, self._none)
