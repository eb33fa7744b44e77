"""The interface of an estimator, and the estimator that takes every sample as the state.

An estimator is pure. Its memory is a flat dictionary of arrays, as an oracle's is, so that a keyframe can store it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import NamedTuple

import numpy as np

from lbmpc.plants.linear_motion import Pieces

EstimatorState = dict[str, np.ndarray]

LAST = 2**63 - 1
"""Largest number of a sample: a signed 64-bit integer."""


class Measured(NamedTuple):
    """One sample as received, in deviation coordinates."""

    y: np.ndarray
    """Measurements, (d,). Entries of states that are not measured are ignored."""
    source: int
    sequence: int
    """Number of the sample within its source."""
    applied: np.ndarray | None
    """Mean input of the period that ended with the sample, (m,); None if it is not known."""
    pieces: Pieces
    """The inputs of that period if there were several."""


class Estimate(NamedTuple):
    """The estimate after a sample, in deviation coordinates."""

    x: np.ndarray
    """The state at the sample, (d,)."""
    reached: np.ndarray
    """The state, (d,), whose distance from A x + B u is the label of the period, with x the estimate before."""
    variance: np.ndarray
    """Variance of that label, (d,), units of h squared; zeros if a sample is the state."""
    innovation: np.ndarray
    """Measurement minus prediction, (d,); NaN if either is missing."""
    innovation_variance: np.ndarray
    """Variance of the innovation under the estimator's assumptions, (d,); NaN likewise."""


class Estimator(ABC):
    """Computes the state from measurements."""

    sees_all: bool
    """Whether every state is measured."""

    @abstractmethod
    def update(self, state: EstimatorState, seen: Measured) -> tuple[EstimatorState, Estimate]:
        """Return the memory and the estimate after one more sample."""

    def initial_state(self) -> EstimatorState:
        """Return the memory before the first sample."""
        return {}

    def found_noise(self, state: EstimatorState) -> np.ndarray:
        """Return the estimated standard deviation of the measurement noise, (d,), in units of the states.

        Entries of states that are not measured are 0. The result is (0,) for an estimator that does not estimate it.
        """
        return np.zeros(0)

    def tells(self, y: np.ndarray) -> bool:
        """Return whether a sample, (d,), with NaN for missing numbers, contains information."""
        return bool(np.isfinite(y).all())

    def faults(self, state: EstimatorState) -> dict[str, str]:
        """Return the distrusted sensors: state name to a description of the fault."""
        return {}

    def deviation(self, state: EstimatorState) -> np.ndarray:
        """Return the standard deviation of the estimated state, (d,), in its units; (0,) if a sample is the state."""
        return np.zeros(0)

    def missed(self, state: EstimatorState, delay: float) -> EstimatorState:
        """Return the memory after a period without a sample; `delay` is the seconds from a sample to its command."""
        return state

    def commanded(self, state: EstimatorState, u: np.ndarray) -> EstimatorState:
        """Return the memory after an input, (m,), was sent. It is needed because a missing sample reports no input."""
        return state


class Samples(Estimator):
    """An estimator without memory that takes every sample as the state."""

    sees_all = True

    def __init__(self, d: int):
        self._exact, self._none = np.zeros(d), np.full(d, np.nan)

    def update(self, state: EstimatorState, seen: Measured) -> tuple[EstimatorState, Estimate]:
        return state, Estimate(seen.y, seen.y, self._exact, self._none, self._none)
