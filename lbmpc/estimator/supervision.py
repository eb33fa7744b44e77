"""Sensor supervision: finds stuck, dead and offset sensors from their readings and innovations, and ignores them.

**Stuck.** A reading that contains noise does not repeat. A repeated reading carries no information and is not used: the
filter then predicts the state from the other sensors. The sensor is reported as stuck once the prediction is three
standard deviations of the noise away from the reading. A quantised sensor can repeat without a fault; the steps between
its readings show the quantisation. Its repeated readings are used while the prediction is less certain than they are,
and the sensor is reported only if the filter is certain too.

**Dead.** The sensor delivers no number. A reading of 0 that does not change counts as stuck.

**Off.** A sudden bias gives a large innovation that stays constant, in one sensor alone. A disturbance of the plant
keeps growing, and a real jump of the state soon shows in other sensors; in both cases the reading is correct. The limit
for a large innovation follows the innovations of the last 20 samples, so that a wrong model or an underestimated noise
does not count as a fault. A slowly growing bias cannot be told from a disturbance.

The innovation of a distrusted sensor is still computed. The sensor is trusted again after it was small for a second.
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
"""Number of equal readings after the first one before a sensor can be reported as stuck."""
ABSENT = 3
"""Consecutive samples without a number from a sensor before it is reported as dead."""
MOVED = 3.0
"""Standard deviations: of the noise, for the distance from a stuck reading; of an innovation, if quantised."""
SAME_INPUT = 1e-6
"""Half-widths. Two inputs that differ by less are equal, so that the plant may be at rest."""
FINE = 0.25
"""Share of the noise's standard deviation. A sensor with a smaller step does not repeat a reading without a fault."""
ROUNDING, TINY = 1e-6, 1e-300
"""Smallest step of a sensor, relative to the noise's standard deviation; and smallest divisor."""
KNOWS_LESS = 9.0
"""Ratio of the variances of prediction and noise from which on a quantised sensor's repeated reading is used."""
LEAP = 8.0
"""Recent standard deviations of the innovations. A reading with a larger innovation is not used at once."""
LATELY = 20
"""Samples over which these standard deviations are averaged."""
STAYS = 4.0
"""Standard deviations of the difference of two readings. An innovation that changes by more comes from a motion."""
LASTS = 10
"""Samples for which a large innovation must stay constant before the sensor is reported as off."""
AGREES = 4.0
"""Standard deviations. Larger innovations keep a distrusted sensor from being trusted again."""
WELL, WELL_SAMPLES = 1.0, 8
"""Seconds, and the minimum number of samples, for which the sensor must agree."""
ALIVE = 5
"""After this multiple of that time a stuck or dead sensor is trusted if it moves, as the estimate may be wrong."""

# Rows of the counts in the memory.
REPEATED, GONE, LEAPT, AGREED, MOVING, FAULT = range(6)


class SupervisedEstimator(Estimator):
    """An estimator that passes only trusted measurements to a Kalman filter.

    Args:
        inner: the Kalman filter.
        model: the nominal model.
        measured: indices of the measured states.
    """

    def __init__(self, inner: KalmanEstimator, model: Model, measured: np.ndarray):
        self._inner, self.sees_all, self._model = inner, inner.sees_all, model
        self._measured = np.zeros(model.d, dtype=bool)
        self._measured[measured] = True
        self._well = max(WELL_SAMPLES, round(WELL / model.period))
        self._unseen = cache(self._describe_unobservable)

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
        # Without a known input (a hold or a restart) the plant may not have moved.
        same = numbers & (seen.y == state["reading"]) & (seen.applied is not None)
        step, fine = self._steps(state["reading"], state["step"], seen.y, numbers & ~same, noise)
        if (same == numbers).all() and self._rests(state):
            # A plant at rest may repeat its readings without a fault.
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
        # After a jump that is now accepted, the average takes the new size at once.
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
        """Return the counts with updated faults; `moved` (d,) marks states that have left their readings."""
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
        """Whether the last two commanded inputs are equal."""
        before, last = state["inputs"]
        return bool((np.abs(last - before) <= SAME_INPUT * self._model.plant.u_scale).all())

    def _steps(
        self, reading: np.ndarray, step: np.ndarray, y: np.ndarray, changed: np.ndarray, noise: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the step of each sensor, (d,), 0 before the first, and whether the step is fine.

        The step is the common divisor of all changes so far, found by one division of Euclid's algorithm per change.
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
        """Return the readings to ignore because of a jump, (d,), and the innovations at which the jumps began, (d,)."""
        leaps, lately = state["counts"][LEAPT], state["lately"]
        leapt = usable & (away > np.where(leaps > 0, AGREES, LEAP) * np.sqrt(variance * lately))
        change = np.abs(innovation - state["leap"])
        leapt &= (leaps == 0) | (change <= STAYS * self._inner.noise(state) * np.sqrt(2.0 * lately))
        if leapt.sum() > 1:
            # Jumps in two sensors at once come from the plant. The first sample is ignored until the next confirms it.
            leapt &= leaps == 0
        return leapt, np.where(leapt & (leaps == 0), innovation, state["leap"])

    def _describe_unobservable(self, trusted: tuple[int, ...]) -> str:
        """Describe the effect on the states whose sensors are not among the trusted ones."""
        if not trusted:
            return "nothing is measured any more"
        unseen = unobservable(self._model, np.array(trusted))
        if not unseen:
            return "what it measures is estimated from the others"
        names = ", ".join(self._model.plant.states[i] for i in unseen)
        return f"nothing that is measured tells of {names} any more"
