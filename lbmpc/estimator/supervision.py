"""Which measurements count: sensors that are stuck, dead or off, found by their readings and their innovations.

**Stuck.** A reading with noise in it does not repeat. One that does says nothing new, and is not used: the filter then
predicts the state from the others. The sensor is named once the prediction has left it by three deviations of the
noise. A sensor may be quantised, which the steps between its readings tell, and then repeats honestly: its repeated
readings count where the prediction knows less than they do, and it is named only where the filter is sure as well.

**Dead.** No number comes of it, or one that stands still: 0 is a stuck reading like another.

**Off.** A bias that comes at once is an innovation out of all proportion that stays what it is, in one sensor alone. A
disturbance of the plant goes on growing, and what really jumped shows in the other sensors soon: then the reading is
right. What counts as out of proportion follows the innovations of the last 20 samples, so that a model that is wrong,
or noise that was told too small, is no fault. A bias that grows slowly is a disturbance to everybody.

A sensor that is not believed has an innovation all the same, and is believed again when that was small for a second.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from lbmpc.estimator.base import Estimate, Estimator, EstimatorState, Measured
from lbmpc.estimator.kalman import KalmanEstimator, unobservable
from lbmpc.model import Model

WORDS = ("", "stuck", "dead", "off")
NONE, STUCK, DEAD, OFF = range(4)

REPEATS = 4
"""Readings after the first that are all the same, before a sensor may be named stuck."""
ABSENT = 3
"""Samples in a row without a number of it, before a sensor is named dead."""
MOVED = 3.0
"""Deviations: of the noise, by which the state must have moved; of an innovation, for a quantised sensor."""
SAME_INPUT = 1e-6
"""Half-widths, by which the inputs of a plant that rests may differ."""
FINE = 0.25
"""Of the deviation of the noise: a sensor with a smaller step does not repeat honestly."""
ROUNDING, TINY = 1e-6, 1e-300
"""Of the noise's deviation: what is no step. And what is no divisor."""
KNOWS_LESS = 9.0
"""Variance of a prediction, in that of the noise, from which on an honestly repeated reading says more."""
LEAP = 8.0
"""Deviations of the innovations as they were lately: one that is larger is not used at once."""
LATELY = 20
"""Samples that `LEAP` looks back."""
STAYS = 4.0
"""Deviations of the difference of two readings: an innovation that changes by more is no bias, but a motion."""
LASTS = 10
"""Samples for which a leap stays what it is, before a sensor is named off."""
AGREES = 4.0
"""Deviations of an innovation, at most, of a sensor that may be believed again."""
WELL, WELL_SAMPLES = 1.0, 8
"""Seconds, and samples at least, for which it must agree."""
ALIVE = 5
"""So many times as long, and one that was stuck or dead is believed if it only moves: the estimate may be wrong."""

# Rows of the counts in the memory.
REPEATED, GONE, LEAPT, AGREED, MOVING, FAULT = range(6)


class SupervisedEstimator(Estimator):
    """An estimator that is told which measurements count.

    Args:
        inner: what estimates.
        model: the nominal model.
        measured: indices of the states that are measured.
    """

    def __init__(self, inner: KalmanEstimator, model: Model, measured: np.ndarray):
        self._inner, self.sees_all, self._model = inner, inner.sees_all, model
        self._measured = np.zeros(model.d, dtype=bool)
        self._measured[measured] = True
        self._well = max(WELL_SAMPLES, round(WELL / model.period))
        self._unseen = cache(self._words_of_unseen)

    def initial_state(self) -> EstimatorState:
        nothing = np.zeros(self._model.d)
        return {
            **self._inner.initial_state(),
            "reading": nothing,
            "step": nothing,
            "lately": np.ones_like(nothing),
            "leap": nothing,
            "counts": np.zeros((6, len(nothing)), dtype=np.int64),
        }

    def missed(self, state: EstimatorState, delay: float) -> EstimatorState:
        return self._inner.missed(state, delay)

    def commanded(self, state: EstimatorState, u: np.ndarray) -> EstimatorState:
        return self._inner.commanded(state, u)

    def tells(self, y: np.ndarray) -> bool:
        return bool(np.isfinite(y[self._measured]).any())

    def found_noise(self, state: EstimatorState) -> np.ndarray:
        return self._inner.found_noise(state)

    def deviation(self, state: EstimatorState) -> np.ndarray:
        return self._inner.deviation(state)

    def faults(self, state: EstimatorState) -> dict[str, str]:
        fault = state["counts"][FAULT]
        if not fault.any():
            return {}
        unseen = self._unseen(tuple(np.flatnonzero(self._measured & (fault == 0)).tolist()))
        return {self._model.plant.states[i]: f"{WORDS[fault[i]]}; {unseen}" for i in np.flatnonzero(fault)}

    def update(self, state: EstimatorState, seen: Measured) -> tuple[EstimatorState, Estimate]:
        counts, numbers = state["counts"], np.isfinite(seen.y) & self._measured
        noise = self._inner.noise(state)
        # Of a plant that was held, or started again, nobody knows that it moved.
        same = numbers & (seen.y == state["reading"]) & (seen.applied is not None)
        step, fine = self._steps(state["reading"], state["step"], seen.y, numbers & ~same, noise)
        if (same == numbers).all() and self._rests(state):
            # A plant that rests: a repetition alone proves nothing.
            fine[:] = False
        usable = numbers & (counts[FAULT] == 0)

        expected = self._inner.expected(state, seen)
        known = np.isfinite(expected.innovation) & numbers
        away = np.where(known, np.abs(expected.innovation), 0.0)
        variance = np.where(known, expected.innovation_variance, np.inf)
        leapt, leap = self._leaps(state, expected.innovation, away, variance, usable & ~same)
        vague = variance > (1.0 + KNOWS_LESS) * noise**2
        used = usable & ~(same & fine) & ~leapt & (~same | vague)
        memory, estimate = self._inner.corrected(expected, seen, used)

        sure = fine | ((away > MOVED * np.sqrt(variance)) & (away > step))
        agrees = known & (away <= AGREES * np.sqrt(variance))
        counted = np.stack(
            [
                np.where(same, counts[REPEATED] + 1, 0),
                np.where(numbers | ~self._measured, 0, counts[GONE] + 1),
                np.where(leapt, counts[LEAPT] + 1, 0),
                np.where(agrees, counts[AGREED] + ~same, 0),
                np.where(numbers & ~(same & fine), counts[MOVING] + ~same, 0),
                counts[FAULT],
            ]
        )
        before, share = state["lately"], away**2 / variance
        lately = before + np.where(used, np.minimum(share, LEAP**2 * before) - before, 0.0) / LATELY
        # What leapt and is believed now is followed, however long that takes.
        lately = np.where(used & (counts[LEAPT] > 0), np.maximum(lately, share), lately)
        return {
            **memory,
            "reading": np.where(numbers, seen.y, state["reading"]),
            "step": step,
            "lately": np.maximum(1.0, lately),
            "leap": leap,
            "counts": self._judged(counted, (away > MOVED * noise) & sure),
        }, estimate

    def _judged(self, counts: np.ndarray, moved: np.ndarray) -> np.ndarray:
        """The counts with what is wrong by now; moved: whose states have left their readings, (d,)."""
        before = counts[FAULT]
        well = counts[AGREED] >= self._well
        well |= (before != OFF) & (counts[MOVING] >= ALIVE * self._well)
        fault = np.where(well, NONE, before)
        fault[(fault == NONE) & (counts[LEAPT] >= LASTS)] = OFF
        fault[(fault != DEAD) & (counts[REPEATED] >= REPEATS) & moved] = STUCK
        fault[counts[GONE] >= ABSENT] = DEAD
        new = (fault != before) & (fault != NONE)
        judged = counts.copy()
        judged[[AGREED, MOVING]] = np.where(new, 0, counts[[AGREED, MOVING]])
        judged[FAULT] = fault
        return judged

    def _rests(self, state: EstimatorState) -> bool:
        """Whether the last two inputs that were commanded are the same."""
        before, last = state["inputs"]
        return bool((np.abs(last - before) <= SAME_INPUT * self._model.plant.u_scale).all())

    def _steps(
        self, reading: np.ndarray, step: np.ndarray, y: np.ndarray, changed: np.ndarray, noise: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """The step of each sensor, (d,), 0 before the first, and whether it is a fine one.

        It is what all changes so far are multiples of, by one division of Euclid's with each.
        """
        change = np.abs(y - reading)
        left = np.where(step > 0.0, np.abs(change - np.rint(change / np.maximum(step, TINY)) * step), change)
        finer = changed & (reading != 0.0) & (left > ROUNDING * noise)
        step = np.where(finer, left, step)
        return step, (step > 0.0) & (step < FINE * noise)

    def _leaps(
        self,
        state: EstimatorState,
        innovation: np.ndarray,
        away: np.ndarray,
        variance: np.ndarray,
        usable: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Which readings are not to be used for what they leapt, (d,), and from what innovation on, (d,)."""
        leaps, lately = state["counts"][LEAPT], state["lately"]
        leapt = usable & (away > np.where(leaps > 0, AGREES, LEAP) * np.sqrt(variance * lately))
        change = np.abs(innovation - state["leap"])
        leapt &= (leaps == 0) | (change <= STAYS * self._inner.noise(state) * np.sqrt(2.0 * lately))
        if leapt.sum() > 1:
            # Of two at once neither is a sensor's. In the first sample nobody knows whether they go on.
            leapt &= leaps == 0
        return leapt, np.where(leapt & (leaps == 0), innovation, state["leap"])

    def _words_of_unseen(self, believed: tuple[int, ...]) -> str:
        """What becomes of the states whose sensors are not among those, in words."""
        if not believed:
            return "nothing is measured any more"
        unseen = unobservable(self._model, np.array(believed))
        if not unseen:
            return "what it measures is estimated from the others"
        names = ", ".join(self._model.plant.states[i] for i in unseen)
        return f"nothing that is measured tells of {names} any more"
