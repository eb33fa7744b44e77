"""The dead time of a plant, dx/dt = f(x(t), u(t - dead_time)).

A sample reports the inputs that were *written*. The line below remembers them over a period plus the dead time before
the last sample. Its older end is the input that actually acted until that sample; labels and the estimator use it. The
rest is still on its way and cannot be changed. The state is predicted along it to the time at which a new command acts.
The same prediction covers the delay from a sample to its command, with or without a dead time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import groupby
from typing import NamedTuple

import numpy as np

from lbmpc.controller.signals import Observation
from lbmpc.estimator.base import LAST
from lbmpc.model import Model
from lbmpc.oracles.base import Oracle, OracleState
from lbmpc.plants.description import Description
from lbmpc.plants.linear_motion import Pieces

LineState = dict[str, np.ndarray]

A_PERIOD = 4
"""Inputs remembered per period. If there are more, their mean replaces the older ones. A late command adds one."""
SAME = 1e-9
"""Share of a period. Two times that differ by less are equal."""
REPORTED = 1e-3
"""Share of a period. A sample that reports all but this share of the period counts as complete."""


class _Written(NamedTuple):
    seconds: float
    u: np.ndarray
    known: bool
    """True if a sample reported it; False for a command that is not confirmed, or a guess."""


@dataclass(frozen=True, eq=False)
class Acted:
    """A tick as the plant sees it after its dead time."""

    seen: Observation
    """The observation with the inputs that acted instead of those that were written."""
    known: bool
    """Whether all of these inputs are known."""
    ahead: Pieces
    """Inputs that act next, over the dead time; empty without one."""


class InputLine:
    """The inputs that were written and have not acted yet.

    The class is pure. Its memory is a dictionary of arrays, which is empty without a dead time.

    Args:
        plant: gives the dead time and the input before the first command.
        period: seconds.
    """

    def __init__(self, plant: Description, period: float):
        self.dead_time = plant.dead_time
        self._plant, self._period, self._hair = plant, period, SAME * period
        self._span = period + plant.dead_time
        self._rows = A_PERIOD * (math.ceil(self._span / period - SAME) + 1)

    def initial_state(self) -> LineState:
        """Return the memory before the first sample."""
        if self.dead_time == 0.0:
            return {}
        m = self._plant.m
        return {
            # One row per input, newest last: seconds, 1 if known, and the input. A row of zero seconds is free.
            "written": np.zeros((self._rows, 2 + m)),
            "commanded": np.zeros(m),
            "sample": np.array([0, -1], dtype=np.int64),
        }

    def advance(self, line: LineState, seen: Observation, delay: float) -> tuple[LineState, Acted]:
        """Return the memory one tick later, and that tick as the plant sees it after the dead time.

        Args:
            line: the memory.
            seen: the observation of the written inputs. Without a sample, one more period of the command is assumed.
            delay: seconds from a sample to its command.
        """
        if self.dead_time == 0.0:
            return line, Acted(seen, True, ())
        source, sequence = line["sample"].tolist()
        if seen.x is None and sequence < 0:
            return line, Acted(seen, False, ())
        commanded, written = line["commanded"], _rows(line["written"])
        if seen.x is None:
            written += self._guessed(written[-1].u, commanded, delay)
            sequence = min(sequence + 1, LAST)
        else:
            periods = seen.sequence - sequence
            most = self._span / self._period
            # A sample so late that the memory has nothing from before it starts a new line.
            if sequence < 0 or seen.source != source or not 1.0 - most + REPORTED < periods <= most:
                written = [_Written(self._span, self._before(seen), False)]
                written += self._reported(seen, written)
            else:
                # A late sample belongs to a period that was counted already.
                late = max(1 - periods, 0) * self._period
                written = _split(written, _seconds(written) - late, self._hair)[0]
                for _ in range(periods - 1):
                    written += self._guessed(written[-1].u, commanded, delay)
                written += self._reported(seen, self._guessed(written[-1].u, commanded, delay))
            source, sequence = seen.source, seen.sequence
        written = self._last(_joined(written), self._span)
        acted, ahead = _split(written, self._period, self._hair)
        after = {
            **line,
            "written": _array(written, line["written"].shape),
            "sample": np.array([source, sequence], dtype=np.int64),
        }
        return after, Acted(_as_acted(seen, _pieces(acted)), all(one.known for one in acted), _pieces(ahead))

    def commanded(self, line: LineState, u: np.ndarray) -> LineState:
        """Return the memory after an input, (m,), was sent to the gateway."""
        return line if self.dead_time == 0.0 else {**line, "commanded": u}

    def _before(self, seen: Observation) -> np.ndarray:
        """Return the input assumed before the first sample: the present one, or the safe input without its gain."""
        u = acting(seen)
        return self._plant.safe_input - self._plant.u_e if u is None else u

    def _guessed(self, acting: np.ndarray, commanded: np.ndarray, delay: float) -> list[_Written]:
        """Return a period without a sample, in which the command takes over after the delay."""
        both = [_Written(delay, acting, False), _Written(self._period - delay, commanded, False)]
        return [one for one in both if one.seconds > 0.0]

    def _reported(self, seen: Observation, guess: list[_Written]) -> list[_Written]:
        """Return the period before a sample. The start of the period, if not reported, is taken from `guess`."""
        pieces = seen.pieces
        if not pieces and seen.applied is not None:
            pieces = ((self._period, seen.applied),)
        told = self._last([_Written(s, u, True) for s, u in pieces if s > 0.0], self._period, pad=False)
        missing = self._period - _seconds(told)
        if missing > REPORTED * self._period:
            told = [*_split(self._last(guess, self._period), missing, self._hair)[0], *told]
        older, newer = told[: 1 - A_PERIOD], told[1 - A_PERIOD :]
        return [_mean(older), *newer] if older else newer

    def _last(self, written: list[_Written], seconds: float, pad: bool = True) -> list[_Written]:
        """Return the last `seconds` seconds; a shorter list is extended backwards with its first input."""
        kept, left = [], seconds
        for one in reversed(written):
            if left < self._hair:
                break
            kept.append(one if one.seconds <= left + self._hair else one._replace(seconds=left))
            left -= kept[-1].seconds
        kept.reverse()
        if pad and left >= self._hair:
            kept.insert(0, _Written(left, written[0].u, False))
        return kept


def acting(seen: Observation) -> np.ndarray | None:
    """Return the input that acts at the time of the observation, (m,)."""
    return seen.pieces[-1][1] if seen.pieces else seen.applied


def predicted(
    model: Model, oracle: Oracle, state: OracleState, x: np.ndarray, inputs: Pieces
) -> tuple[np.ndarray, OracleState]:
    """Predict the state from x, (d,), under `inputs` by the linear model and h_hat: a partial period, then whole ones.

    Returns:
        The state, (d,), and the oracle's state with the pairs of the whole periods in its past.
    """
    period, hair = model.period, SAME * model.period
    left = [_Written(seconds, u, True) for seconds, u in inputs]
    total = _seconds(left)
    whole = math.floor(total / period + SAME)
    broken = total - whole * period
    if broken > hair:
        part, left = _split(left, broken, hair)
        drift = oracle.estimate(state, x, _mean(part).u) * (broken / period)
        for one in part:
            x = model.ahead(x, one.u, one.seconds)
        x = x + drift
    for _ in range(whole):
        part, left = _split(left, period, hair)
        u, pieces = _mean(part).u, _pieces(part)
        nominal = model.step(x, u) if len(pieces) == 1 else model.A.dot(x) + model.within.answer(pieces)
        after = nominal + oracle.estimate(state, x, u)
        state, x = oracle.passed(state, x, u), after
    return x, state


def _as_acted(seen: Observation, pieces: Pieces) -> Observation:
    if seen.x is None:
        return replace(seen, pieces=pieces)
    if seen.applied is None:
        # After a jump, or without timing, only the present input is used.
        return replace(seen, pieces=pieces[-1:])
    mean = _mean([_Written(seconds, u, True) for seconds, u in pieces]).u
    return replace(seen, applied=mean, pieces=pieces if len(pieces) > 1 else ())


def _rows(array: np.ndarray) -> list[_Written]:
    return [_Written(float(row[0]), row[2:], bool(row[1])) for row in array if row[0] > 0.0]


def _array(written: list[_Written], shape: tuple[int, ...]) -> np.ndarray:
    array, newest = np.zeros(shape), written[-shape[0] :]
    for row, one in zip(array[shape[0] - len(newest) :], newest, strict=True):
        row[0], row[1], row[2:] = one.seconds, one.known, one.u
    return array


def _seconds(written: list[_Written]) -> float:
    return sum(one.seconds for one in written)


def _split(written: list[_Written], seconds: float, hair: float) -> tuple[list[_Written], list[_Written]]:
    """Return the first `seconds` seconds and the rest. A cut within `hair` of a switch is moved to the switch."""
    left = seconds
    for i, one in enumerate(written):
        if left < hair:
            return written[:i], written[i:]
        if one.seconds > left + hair:
            first, second = one._replace(seconds=left), one._replace(seconds=one.seconds - left)
            return [*written[:i], first], [second, *written[i + 1 :]]
        left -= one.seconds
    return written, []


def _joined(written: list[_Written]) -> list[_Written]:
    """Merge equal neighbours."""
    found: list[_Written] = []
    for _key, same in groupby(written, key=lambda one: (one.known, one.u.tolist())):
        first, *others = same
        found.append(first if not others else first._replace(seconds=first.seconds + _seconds(others)))
    return found


def _pieces(written: list[_Written]) -> Pieces:
    return tuple((one.seconds, one.u) for one in _joined([one._replace(known=True) for one in written]))


def _mean(written: list[_Written]) -> _Written:
    if len(written) == 1:
        return written[0]
    total = _seconds(written)
    u = np.asarray(sum(one.seconds / total * one.u for one in written))
    return _Written(total, u, all(one.known for one in written))
