"""A Kalman filter of the nominal model with a disturbance of each state.

    x_{t+1} = A x_t + B u_t + delta_t,    delta_{t+1} = rho delta_t + w_t,    y_t = C x_t + v_t

delta stands for h along the motion: a process of its own standard deviation, the natural scale of W, that becomes
another in so many seconds. Without it the filter would trust a model that is wrong by h, and its estimates would be
off by what h adds up to in the filter's memory. Nothing learned is in here: what the oracle learns from these estimates
does not come back as a label.

The covariance is a memory, not the stationary one: at the start, and after lost samples, less is known.

**Labels.** Of a measured state i, h_i(xhat_t, u_t) is y_{t+1} - A xhat_t - B u_t with xhat_t the estimate *before* that
measurement. Its error is v_{t+1} + A (x_t - xhat_t), of variance R_i + (A P_t A')_i: the filter's innovation, which is
white as far as the process above describes h, less the error of delta. No delta is in the label, so it is not pulled
towards what was believed. Of a state that nobody measures only delta is known; its variance counts as often as
neighbouring labels say the same.
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
"""Half-widths: a standard deviation below this counts as this."""
UNKNOWN = 3.0**-0.5
"""Half-widths: standard deviation of a state that nobody measures, before the first sample: it may be anywhere in X."""
GUESS = 0.01
"""Half-widths: standard deviation of what is measured, where nobody told and the innovations do not say yet."""
LONGEST_GAP = 100
"""Periods, from one sample to the next, after which nothing is known any more."""
LOST = 1e3
"""Half-widths: nothing is known either where a prediction has this standard deviation. Of a plant that runs away it has
no digits left soon after, and no end."""
RANK, PART = 1e-9, 1e-6
"""What counts as nothing: of the largest singular value, and of a mode."""
LASTS = 1.0 - 1e-6
"""|eigenvalue| from which on a mode does not fade."""


class Expected(NamedTuple):
    """What is known of a sample before it counts."""

    state: EstimatorState
    """The memory, predicted to the sample's time."""
    period: tuple[np.ndarray, np.ndarray] | None
    """Where the nominal model led in the period before it, (d,), and the covariance of x where that began, (d, d);
    None: there is no label of that period."""
    innovation: np.ndarray
    """As that of an `Estimate`, and so the next."""
    innovation_variance: np.ndarray
    begins: bool = False
    """Whether nothing is known: what is measured is then where the state begins."""


class KalmanEstimator(Estimator):
    """Of the state and of a disturbance.

    Args:
        model: the nominal model.
        measured: indices of the states that are measured.
        noise: standard deviation of what is measured, (d,), in units of the states; None: it is found from innovations.
        process: that of h, (d,).
        correlation: seconds in which h becomes another, by a factor of e.
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
        self._told = np.zeros(d)
        self._told[measured] = np.maximum(told, least)[measured]
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
        # Of an unmeasured state: how many labels in a row say the same.
        self._repeats = (1.0 + rho) / (1.0 - rho)
        guess = (self._told / units)[measured] ** 2
        self._finder = (
            NoiseFinder(self._F, self._Q, self._unknown, guess, measured) if noise is None else None
        )

    def initial_state(self) -> EstimatorState:
        d = self._model.d
        finder = {} if self._finder is None else {"noise": self._told, **self._finder.initial_state()}
        return {
            **finder,
            "x": np.zeros(d),
            "disturbance": np.zeros(d),
            "covariance": self._unknown,
            "sample": np.array([0, -1], dtype=np.int64),
            "inputs": np.zeros((2, self._model.m)),
        }

    def noise(self, state: EstimatorState) -> np.ndarray:
        """Standard deviation of what is measured, told or found, (d,), in units of the states; 0 of others."""
        return state.get("noise", self._told)

    def found_noise(self, state: EstimatorState) -> np.ndarray:
        return state.get("noise", super().found_noise(state))

    def update(
        self, state: EstimatorState, seen: Measured, trusted: np.ndarray | None = None
    ) -> tuple[EstimatorState, Estimate]:
        """As an `Estimator`; trusted: as for `corrected`."""
        return self.corrected(self.expected(state, seen), seen, trusted)

    def expected(self, state: EstimatorState, seen: Measured) -> Expected:
        """What is known before the sample counts."""
        source, sequence = state["sample"].tolist()
        periods, u = seen.sequence - sequence, seen.applied
        if u is None or sequence < 0 or seen.source != source or periods > LONGEST_GAP:
            return self._begun(state)
        if periods <= 0:
            # The period was counted as missed, and its sample comes late.
            return Expected(state, None, *self._innovation(state, seen.y))
        for _ in range(periods - 1):
            # What acted then is not known.
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
        """The memory and the estimate once the sample counts.

        trusted: of which states, (d,) of booleans, the measurement counts, of those that are measured; None: of all.
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
        """What a sample says of the noise; u: None: it is not the next one, or not all that is measured counts."""
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
            return {**self._afresh(state), "sample": self.initial_state()["sample"]}
        if self._finder is not None:
            after = self._finder.begun(after, self._scaled(after))
        return {**after, "sample": np.array([source, min(sequence + 1, LAST)], dtype=np.int64)}

    def commanded(self, state: EstimatorState, u: np.ndarray) -> EstimatorState:
        return {**state, "inputs": np.stack([state["inputs"][1], u])}

    def _afresh(self, state: EstimatorState) -> EstimatorState:
        """Nothing known of the state: of inputs on their way, and of sensors, all as it was."""
        nothing = np.zeros(self._model.d)
        return {**state, "x": nothing, "disturbance": nothing.copy(), "covariance": self._unknown}

    def _begun(self, state: EstimatorState) -> Expected:
        """Of a sample of which nothing is known that came before."""
        nothing = np.full(self._model.d, np.nan)
        return Expected(self._afresh(state), None, nothing, nothing, begins=True)

    def _is_lost(self, state: EstimatorState) -> bool:
        return not (np.diag(state["covariance"])[: self._model.d] <= self._lost).all()

    def _innovation(self, predicted: EstimatorState, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Of every measured state, trusted or not, and the variance that it would have, (d,) each."""
        d, measured = self._model.d, self._measured
        innovation, variance = np.full(d, np.nan), np.full(d, np.nan)
        innovation[measured] = y[measured] - predicted["x"][measured]
        spread = np.diag(predicted["covariance"])[:d] + self._R(predicted)
        variance[measured] = (spread * self._units**2)[measured]
        return innovation, variance

    def _scaled(self, state: EstimatorState) -> np.ndarray:
        """State and disturbance, (2d,), in the filter's units."""
        return np.concatenate([state["x"] / self._units, state["disturbance"] / self._units])

    def _R(self, state: EstimatorState) -> np.ndarray:
        """Variance of what is measured, (d,), in the filter's units."""
        return (self.noise(state) / self._units) ** 2

    def _nominal(self, x: np.ndarray, u: np.ndarray, pieces: Pieces) -> np.ndarray:
        """Where the nominal model leads within a period, (d,)."""
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
        # Joseph's form: rounding cannot make it indefinite.
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
    """Indices of the states of which no sample ever tells all, and which do not come to rest by themselves either.

    They have a part in a mode of A that does not fade and that what is `measured` does not see.
    """
    d, units = model.d, balanced(model.plant)[: model.d]
    # A and (A - I) / T have the same unseen modes, and at a short period this has more digits.
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
    # Of an invariant subspace, not of eigenvectors: two integrators in a row have one of those.
    _form, vectors, count = schur(inner, sort=lambda re, im: np.hypot(re, im) >= LASTS)
    return np.flatnonzero((np.abs(unseen @ vectors[:, :count]) > PART).any(axis=1)).tolist()
