"""Estimation of the measurement noise from innovations, for a filter without a configured noise.

A filter of constant gain L runs beside the estimator. Its innovations are

    e_t = v_t + sum_{k > 0} M_k v_{t-k} + s_t,    M_k = -C (F - F L C)^{k-1} F L

v is the white noise. s is the effect of h and of a wrong initial state; its size is unknown, but it is slow. Third
differences therefore keep 20 times the variance of white noise and remove almost all of s. This is difference-based
estimation of a variance (Rice 1984; Hall, Kay and Titterington 1990). The mixing by the gain is known, as in the
autocovariance method (Mehra 1970; Odelson, Rajamani and Rawlings 2006). With T the response of filter and differences
together,

    Var (Delta^3 e)_i = sum_j G_ij R_j,    G_ij = sum_k (T_k)_ij^2

is solved for R >= 0. The covariance of the process does not appear. The configured size of h is too large by an unknown
factor, so an estimate that used it would confuse h with noise.

The largest tenth of the differences is ignored. It contains jumps of the input through a wrong gain and the first
samples of states that are not measured. Coloured noise is slow, so only its white part is found.
"""

from __future__ import annotations

import numpy as np

from lbmpc.estimator.base import EstimatorState

DIFFERENCES = np.array([1.0, -3.0, 3.0, -1.0])
SAMPLES = 100
"""Number of differences that are collected. The relative standard deviation of the result is then 11 %."""
FEWEST = 20
"""Minimum number of differences for an estimate."""
KEPT, OF_THOSE = 0.9, 0.6230
"""Share of the squares that is used, the smallest ones; and their mean for a variance of 1."""
SETTLED = 500
"""Steps of the covariance recursion. The gain is then nearly constant; an inexact gain has a known response too."""
LONGEST_ANSWER = 500
"""Samples. The later response of the filter is neglected."""


class NoiseFinder:
    """Estimates the variances of the measurements in the filter's units.

    Args:
        F: transition matrix of state and disturbance, (2d, 2d).
        Q: their process noise, (2d, 2d).
        P: their initial covariance, (2d, 2d).
        R: a guess of the variances, (p,).
        measured: indices of the measured states, (p,).
    """

    def __init__(self, F: np.ndarray, Q: np.ndarray, P: np.ndarray, R: np.ndarray, measured: np.ndarray):
        # nnls is slow to import. It is imported here, because few controllers need it, and not within the loop.
        from scipy.optimize import nnls

        self._F, self._measured, self._nnls = F, measured, nnls
        for _ in range(SETTLED):
            L = np.linalg.solve(P[np.ix_(measured, measured)] + np.diag(R), P[measured]).T
            left = np.eye(len(F))
            left[:, measured] -= L
            P = F @ (left @ P @ left.T + (L * R) @ L.T) @ F.T + Q
        self._L = L
        self._G = self._answers(F @ left, F @ L)

    def _answers(self, closed: np.ndarray, gain: np.ndarray) -> np.ndarray:
        """Return G, (p, p)."""
        p = len(self._measured)
        M = np.zeros((LONGEST_ANSWER, p, p))
        M[0] = np.eye(p)
        for k in range(1, LONGEST_ANSWER):
            M[k], gain = -gain[self._measured], closed @ gain
        T = np.zeros((LONGEST_ANSWER + len(DIFFERENCES) - 1, p, p))
        for k, factor in enumerate(DIFFERENCES):
            T[k : k + LONGEST_ANSWER] += factor * M
        return (T**2).sum(axis=0)

    def initial_state(self) -> EstimatorState:
        p = len(self._measured)
        return {
            "finder.x": np.zeros(len(self._F)),
            "finder.innovations": np.zeros((len(DIFFERENCES), p)),
            "finder.differences": np.zeros((SAMPLES, p)),
            # Number of consecutive innovations, and number of differences.
            "finder.counts": np.zeros(2, dtype=np.int64),
        }

    def begun(self, state: EstimatorState, x: np.ndarray) -> EstimatorState:
        """Return the memory after a sample that does not follow the previous one; x is the estimate there, (2d,)."""
        counts = np.array([0, state["finder.counts"][1]])
        return {**state, "finder.x": x, "finder.counts": counts}

    def followed(
        self, state: EstimatorState, moved: np.ndarray, y: np.ndarray
    ) -> tuple[EstimatorState, np.ndarray | None]:
        """Return the memory after the next sample, and the variances, (p,), once there are enough differences.

        Args:
            state: the memory before.
            moved: contribution of the inputs, added to F x, (2d,).
            y: measurements, (p,).
        """
        row, gathered = state["finder.counts"].tolist()
        if gathered == SAMPLES:
            return state, None
        x = self._F @ state["finder.x"] + moved
        e = y - x[self._measured]
        innovations = np.vstack([e, state["finder.innovations"][:-1]])
        row, differences = row + 1, state["finder.differences"]
        if row >= len(DIFFERENCES):
            differences = differences.copy()
            differences[gathered] = DIFFERENCES @ innovations
            gathered += 1
        after = {
            **state,
            "finder.x": x + self._L @ e,
            "finder.innovations": innovations,
            "finder.differences": differences,
            "finder.counts": np.array([row, gathered]),
        }
        return after, self._variances(differences[:gathered]) if gathered >= FEWEST else None

    def _variances(self, differences: np.ndarray) -> np.ndarray:
        kept = int(KEPT * len(differences))
        sizes = np.sort(differences**2, axis=0)[:kept].mean(axis=0) / OF_THOSE
        # Scale each equation by its own size, so that quiet and noisy sensors have equal weight.
        sizes = np.maximum(sizes, np.finfo(float).tiny)
        return self._nnls(self._G / sizes[:, None], np.ones(len(sizes)))[0]
