"""A Kalman filter for the nominal model with a disturbance of each state.

    x_{t+1} = A x_t + B u_t + delta_t,    delta_{t+1} = rho delta_t + w_t,    y_t = C x_t + v_t

delta models h along the motion. It has the natural scale of W as standard deviation and a configured correlation
time. Without delta the filter would trust a model that is wrong by h, and its estimates would carry the sum of h
over the filter's memory. The filter uses nothing that was learned. A label therefore never contains the oracle's own
estimate.

The covariance is time-varying, not the stationary one, because less is known at the start and after lost samples.

**Labels.** For a measured state i, h_i(xhat_t, u_t) is y_{t+1} - A xhat_t - B u_t, where xhat_t is the estimate
*before* that measurement. Its error is v_{t+1} + A (x_t - xhat_t), with variance R_i + (A P_t A')_i. This is the
filter's innovation without the error of delta; it is white as far as the process above describes h. The label does not
contain delta, so it is not biased towards the prior. For a state that is not measured only delta is known. Its variance
is multiplied by the number of neighbouring labels that carry the same information.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import schur

from lbmpc.estimator.base import LAST, Estimate, Estimator, EstimatorState, Measured
from lbmpc.estimator.noise import NoiseFinder
from lbmpc.model import Model
from lbmpc.plants.linear_motion import Pieces, balanced

LEAST = 1e-6
"""Half-widths. Smaller standard deviations are raised to this value."""
UNKNOWN = 3.0**-0.5
"""Half-widths. Initial standard deviation of a state that is not measured: it may be anywhere in X."""
GUESS = 0.01
"""Half-widths. Assumed noise where none is configured and the innovations have not been evaluated yet."""
LONGEST_GAP = 100
"""Periods from one sample to the next. After a longer gap the filter starts again."""
LOST = 1e3
"""Half-widths. The filter starts again when a prediction has this standard deviation. On an unstable plant the
prediction would soon lose all digits."""
RANK, PART = 1e-9, 1e-6
"""Numerical zero, relative to the largest singular value and to a mode."""
LASTS = 1.0 - 1e-6
"""A mode with |eigenvalue| from this value on does not decay."""


class Expected(NamedTuple):
    """The knowledge about a sample before its measurements are used."""

    state: EstimatorState
    """The memory, predicted to the time of the sample."""
    period: tuple[np.ndarray, np.ndarray] | None
    """Prediction of the nominal model over the period before the sample, (d,), and the covariance of x at its start,
    (d, d); None if that period has no label."""
    innovation: np.ndarray
    """As in `Estimate`; likewise the next field."""
    innovation_variance: np.ndarray
    begins: bool = False
    """True if nothing is known, so that the state begins at the measurements."""


class KalmanEstimator(Estimator):
    """Estimates the state and a disturbance.

    Args:
        model: the nominal model.
        measured: indices of the measured states.
        noise: standard deviation of the measurements, (d,), in units of the states; None to find it from innovations.
        process: standard deviation of h, (d,).
        correlation: seconds after which the correlation of h has dropped by a factor of e.
    """

    def __init__(
        self,
        model: Model,
        measured: np.ndarray,
        noise: np.ndarray | None,
        process: np.ndarray,
        correlation: float,
    ):
        d = model.d
        self._model, self._measured = model, measured
        self.sees_all = len(measured) == d
        units = self._units = balanced(model.plant)[:d]
        least = self._least = LEAST * model.plant.x_scale
        told = GUESS * model.plant.x_scale if noise is None else noise
        self._noise = np.zeros(d)
        self._noise[measured] = np.maximum(told, least)[measured]
        sigma = np.maximum(process, least * model.period) / units
        rho = self._kept = float(np.exp(-model.period / correlation))
        self._F = np.block(
            [[model.A * units / units[:, None], np.eye(d)], [np.zeros((d, d)), rho * np.eye(d)]]
        )
        self._Q = np.diag(np.concatenate([np.zeros(d), (1.0 - rho**2) * sigma**2]))
        x = UNKNOWN * model.plant.x_scale / units
        self._unknown = np.diag(np.concatenate([x, sigma]) ** 2)
        self._lost = (LOST * model.plant.x_scale / units) ** 2
        inputs = model.B * model.plant.u_scale / units[:, None]
        self._any_input = np.zeros((2 * d, 2 * d))
        self._any_input[:d, :d] = inputs @ inputs.T
        # For an unmeasured state: number of consecutive labels that carry the same information.
        self._repeats = (1.0 + rho) / (1.0 - rho)
        guess = (self._noise / units)[measured] ** 2
        self._finder = (
            NoiseFinder(self._F, self._Q, self._unknown, guess, measured) if noise is None else None
        )

    def initial_state(self) -> EstimatorState:
        d = self._model.d
        finder = {} if self._finder is None else {"noise": self._noise, **self._finder.initial_state()}
        return {
            **finder,
            "x": np.zeros(d),
            "disturbance": np.zeros(d),
            "covariance": self._unknown,
            "sample": np.array([0, -1], dtype=np.int64),
            "inputs": np.zeros((2, self._model.m)),
        }

    def noise(self, state: EstimatorState) -> np.ndarray:
        """Return the configured or estimated standard deviation of the measurements, (d,); 0 for unmeasured states."""
        return state.get("noise", self._noise)

    def found_noise(self, state: EstimatorState) -> np.ndarray:
        return state.get("noise", super().found_noise(state))

    def update(
        self, state: EstimatorState, seen: Measured, trusted: np.ndarray | None = None
    ) -> tuple[EstimatorState, Estimate]:
        """Update as an `Estimator` does; `trusted` is that of `corrected`."""
        return self.corrected(self.expected(state, seen), seen, trusted)

    def expected(self, state: EstimatorState, seen: Measured) -> Expected:
        """Return what is known before the measurements of the sample are used."""
        source, sequence = state["sample"].tolist()
        periods, u = seen.sequence - sequence, seen.applied
        if u is None or sequence < 0 or seen.source != source or periods > LONGEST_GAP:
            return self._begun(state)
        if periods <= 0:
            # The period was counted as missed already; its sample arrives late.
            return Expected(state, None, *self._innovation(state, seen.y))
        for _ in range(periods - 1):
            # The inputs of the missing periods are not known.
            state = self._predicted(state, self._nominal(state["x"], u, ()))
            state = {**state, "covariance": state["covariance"] + self._any_input}
            if self._is_lost(state):
                return self._begun(state)
        nominal, d = self._nominal(state["x"], u, seen.pieces), self._model.d
        predicted = self._predicted(state, nominal)
        if self._is_lost(predicted):
            return self._begun(state)
        period = nominal, state["covariance"][:d, :d]
        return Expected(predicted, period, *self._innovation(predicted, seen.y))

    def corrected(
        self, expected: Expected, seen: Measured, trusted: np.ndarray | None = None
    ) -> tuple[EstimatorState, Estimate]:
        """Return the memory and the estimate after the measurements of the sample.

        trusted: (d,) of booleans, the measured states whose measurement is used; None for all.
        """
        d, prior = self._model.d, expected.state
        measured = self._measured if trusted is None else self._measured[trusted[self._measured]]
        if expected.begins:
            prior = {**prior, "x": prior["x"].copy()}
            prior["x"][measured] = seen.y[measured]
        after = self._corrected(prior, seen.y, measured)
        reached, variance = after["x"], np.full(d, np.inf)
        if expected.period is not None:
            nominal, before = expected.period
            reached = nominal + after["disturbance"]
            reached[measured] = seen.y[measured]
            variance = np.diag(after["covariance"])[d:] * self._repeats
            A = self._F[measured, :d]
            variance[measured] = self._R(prior)[measured] + ((A @ before) * A).sum(axis=1)
            variance = variance * self._units**2
        estimate = Estimate(after["x"], reached, variance, expected.innovation, expected.innovation_variance)
        after = {**after, "sample": np.array([seen.source, seen.sequence], dtype=np.int64)}
        if self._finder is not None:
            follows = seen.sequence - prior["sample"].tolist()[1] == 1 and np.isfinite(variance).all()
            usable = seen.applied if follows and len(measured) == len(self._measured) else None
            after = self._with_noise(self._finder, after, seen, usable)
        return after, estimate

    def _with_noise(
        self, finder: NoiseFinder, after: EstimatorState, seen: Measured, u: np.ndarray | None
    ) -> EstimatorState:
        """Update the noise estimate. `u` is None if the sample is not the next one, or a sensor is distrusted."""
        d, measured, units = self._model.d, self._measured, self._units
        if u is None:
            return finder.begun(after, self._scaled(after))
        moved = np.concatenate([self._nominal(np.zeros(d), u, seen.pieces) / units, np.zeros(d)])
        after, R = finder.followed(after, moved, (seen.y / units)[measured])
        if R is None:
            return after
        noise = after["noise"].copy()
        noise[measured] = np.maximum(np.sqrt(R) * units[measured], self._least[measured])
        return {**after, "noise": noise}

    def deviation(self, state: EstimatorState) -> np.ndarray:
        return self._units * np.sqrt(np.diag(state["covariance"])[: self._model.d])

    def missed(self, state: EstimatorState, delay: float) -> EstimatorState:
        source, sequence = state["sample"].tolist()
        if sequence < 0:
            return state
        first, then = state["inputs"]
        pieces = ((delay, first), (self._model.period - delay, then)) if delay > 0.0 else ()
        after = self._predicted(state, self._nominal(state["x"], then, pieces))
        if self._is_lost(after):
            return {**self._reset(state), "sample": self.initial_state()["sample"]}
        if self._finder is not None:
            after = self._finder.begun(after, self._scaled(after))
        return {**after, "sample": np.array([source, min(sequence + 1, LAST)], dtype=np.int64)}

    def commanded(self, state: EstimatorState, u: np.ndarray) -> EstimatorState:
        return {**state, "inputs": np.stack([state["inputs"][1], u])}

    def _reset(self, state: EstimatorState) -> EstimatorState:
        """Return the memory with an unknown state. Commanded inputs and noise estimates are kept."""
        nothing = np.zeros(self._model.d)
        return {**state, "x": nothing, "disturbance": nothing.copy(), "covariance": self._unknown}

    def _begun(self, state: EstimatorState) -> Expected:
        """Return what is known about a sample without a usable past."""
        nothing = np.full(self._model.d, np.nan)
        return Expected(self._reset(state), None, nothing, nothing, begins=True)

    def _is_lost(self, state: EstimatorState) -> bool:
        return not (np.diag(state["covariance"])[: self._model.d] <= self._lost).all()

    def _innovation(self, predicted: EstimatorState, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the innovation of every measured state, trusted or not, and its expected variance, (d,) each."""
        d, measured = self._model.d, self._measured
        innovation, variance = np.full(d, np.nan), np.full(d, np.nan)
        innovation[measured] = y[measured] - predicted["x"][measured]
        spread = np.diag(predicted["covariance"])[:d] + self._R(predicted)
        variance[measured] = (spread * self._units**2)[measured]
        return innovation, variance

    def _scaled(self, state: EstimatorState) -> np.ndarray:
        """Return state and disturbance, (2d,), in the filter's units."""
        return np.concatenate([state["x"] / self._units, state["disturbance"] / self._units])

    def _R(self, state: EstimatorState) -> np.ndarray:
        """Return the variance of the measurements, (d,), in the filter's units."""
        return (self.noise(state) / self._units) ** 2

    def _nominal(self, x: np.ndarray, u: np.ndarray, pieces: Pieces) -> np.ndarray:
        """Return the prediction of the nominal model over one period, (d,)."""
        return self._model.A.dot(x) + (self._model.within.answer(pieces) if pieces else self._model.B.dot(u))

    def _predicted(self, state: EstimatorState, nominal: np.ndarray) -> EstimatorState:
        P = self._F @ state["covariance"] @ self._F.T + self._Q
        return {
            **state,
            "x": nominal + state["disturbance"],
            "disturbance": self._kept * state["disturbance"],
            "covariance": 0.5 * (P + P.T),
        }

    def _corrected(self, state: EstimatorState, y: np.ndarray, measured: np.ndarray) -> EstimatorState:
        d, P, R = self._model.d, state["covariance"], self._R(state)[measured]
        S = P[np.ix_(measured, measured)] + np.diag(R)
        gain = np.linalg.solve(S, P[measured]).T
        moved = gain @ ((y - state["x"])[measured] / self._units[measured])
        # Joseph's form keeps the covariance positive semidefinite under rounding.
        left = np.eye(2 * d)
        left[:, measured] -= gain
        P = left @ P @ left.T + (gain * R) @ gain.T
        return {
            **state,
            "x": state["x"] + self._units * moved[:d],
            "disturbance": state["disturbance"] + self._units * moved[d:],
            "covariance": 0.5 * (P + P.T),
        }


def unobservable(model: Model, measured: np.ndarray) -> list[int]:
    """Return the indices of the states that the samples do not determine and that do not decay either.

    These states have a part in a mode of A that is neither stable nor visible in the `measured` states.
    """
    d, units = model.d, balanced(model.plant)[: model.d]
    # A and (A - I) / T have the same unobservable modes. The latter has more digits at a short period.
    slope = (model.A * units / units[:, None] - np.eye(d)) / model.period
    slope = slope / max(np.abs(slope).sum(axis=1).max(), 1e-300)
    rows = [np.eye(d)[measured]]
    for _ in range(d - 1):
        rows.append(rows[-1] @ slope)
    _left, sizes, right = np.linalg.svd(np.vstack(rows))
    unseen = right[int((sizes > RANK * sizes[0]).sum()) :].T
    if not unseen.size:
        return []
    inner = unseen.T @ (model.A * units / units[:, None]) @ unseen
    # Use the invariant subspace, because a chain of integrators has a single eigenvector.
    _form, vectors, count = schur(inner, sort=lambda re, im: np.hypot(re, im) >= LASTS)
    return np.flatnonzero((np.abs(unseen @ vectors[:, :count]) > PART).any(axis=1)).tolist()
