"""How noisy the sensors are, from innovations: for a filter that nobody told.

A filter of constant gain L runs beside the estimator, and its innovations are

    e_t = v_t + sum_{k > 0} M_k v_{t-k} + s_t,    M_k = -C (F - F L C)^{k-1} F L

v is the noise, white; s is what h and a wrong start do, whose size nobody knows, but it is slow. So third differences
are taken, which of white noise leave 20 times its variance and of what is slow next to nothing: difference-based
estimation of a variance (Rice 1984; Hall, Kay and Titterington 1990). What the gain mixes is known, as in the
autocovariance method (Mehra 1970; Odelson, Rajamani and Rawlings 2006): with T the filter's answer and the differences
in one,

    Var (Delta^3 e)_i = sum_j G_ij R_j,    G_ij = sum_k (T_k)_ij^2

which is solved for R >= 0. No covariance of the process is in it: what one is told of h is too large by an unknown
factor, and would be taken for noise, or noise for it.

The largest tenth of the differences does not count: jumps of the input through a wrong gain, or the first samples of
states that nobody measures. Noise that is coloured is slow too, and only its white part is found.
"""

from __future__ import annotations

import numpy as np

from lbmpc.estimator.base import EstimatorState

DIFFERENCES = np.array([1.0, -3.0, 3.0, -1.0])
SAMPLES = 100
"""How many differences are gathered. That leaves a standard deviation of the deviation found of 11 %."""
FEWEST = 20
"""From so many on they count."""
KEPT, OF_THOSE = 0.9, 0.6230
"""Share of the squares that count, the smallest; and their mean where the variance is 1."""
SETTLED = 500
"""Steps of the covariance, after which its gain is constant enough: whatever it is, its answer is known."""
LONGEST_ANSWER = 500
"""Samples; later ones of the filter's answer are nothing."""


class NoiseFinder:
    """Of what is measured, in the filter's own units.

    Args:
        F: of the state and the disturbance, (2d, 2d).
        Q: their process noise, (2d, 2d).
        P: their covariance at the start, (2d, 2d).
        R: a guess of the variances, (p,).
        measured: indices of the states that are measured, (p,).
    """

    def __init__(self, F: np.ndarray, Q: np.ndarray, P: np.ndarray, R: np.ndarray, measured: np.ndarray):
        # Slow to load, and most controllers are told their noise; but not within the loop.
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
        """G, (p, p)."""
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
            # Innovations in a row, and differences so far.
            "finder.counts": np.zeros(2, dtype=np.int64),
        }

    def begun(self, state: EstimatorState, x: np.ndarray) -> EstimatorState:
        """The memory after a sample that does not follow the one before; x: the estimate there, (2d,)."""
        counts = np.array([0, state["finder.counts"][1]])
        return {**state, "finder.x": x, "finder.counts": counts}

    def followed(
        self, state: EstimatorState, moved: np.ndarray, y: np.ndarray
    ) -> tuple[EstimatorState, np.ndarray | None]:
        """The memory after the next sample, and the variances, (p,), as soon as something is known of them.

        Args:
            state: the memory before.
            moved: what the inputs add to F x, (2d,).
            y: what was measured, (p,).
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
        # Each equation by its own size: a quiet sensor counts as much as a noisy one.
        sizes = np.maximum(sizes, np.finfo(float).tiny)
        return self._nnls(self._G / sizes[:, None], np.ones(len(sizes)))[0]
