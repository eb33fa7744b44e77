"""A plant that answers to an input `dead_time` seconds after it was written, dx/dt = f(x(t), u(t - dead_time)).

What a sample says acted is what was *written*. The line below remembers what was, over a period and the dead time
before the last sample. Its older end is what really acted until that sample: labels and the estimator see that. The
rest is on its way, and no command changes it any more: along it the state is predicted to when a new command acts.
The same prediction goes over the delay from a sample to its command, with or without a dead time.
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
"""Inputs that are remembered of a period; of more, the older become their mean. A late command makes two."""
SAME = 1e-9
"""Of a period: two moments that are so near are one."""
REPORTED = 1e-3
"""Of a period: what is missing of it at most where a sample tells of all of it."""


class _Written(NamedTuple):
    seconds: float
    u: np.ndarray
    known: bool
    """Whether a sample said so; else it was commanded, or is a guess."""


@dataclass(frozen=True, eq=False)
class Acted:
    """A tick as the plant sees it behind its dead time."""

    seen: Observation
    """The observation with what really acted in the place of what was written."""
    known: bool
    """Whether all of that is known."""
    ahead: Pieces
    """What acts next, for the dead time; nothing without one."""


class InputLine:
    """What was written and has not acted yet. Pure; its memory is a dictionary of arrays, empty without a dead time.

    Args:
        plant: its dead time, and what it applies before anybody commands it.
        period: seconds.
    """

    def __init__(self, plant: Description, period: float):
        self.dead_time = plant.dead_time
        self._plant, self._period, self._hair = plant, period, SAME * period
        self._span = period + plant.dead_time
        self._rows = A_PERIOD * (math.ceil(self._span / period - SAME) + 1)

    def initial_state(self) -> LineState:
        """The memory before the first sample."""
        if self.dead_time == 0.0:
            return {}
        m = self._plant.m
        return {
            # Seconds, whether it is known, and the input, one a row, the newest last; a row of no seconds is free.
            "written": np.zeros((self._rows, 2 + m)),
            "commanded": np.zeros(m),
            "sample": np.array([0, -1], dtype=np.int64),
        }

    def advance(self, line: LineState, seen: Observation, delay: float) -> tuple[LineState, Acted]:
        """The memory one tick later, and that tick behind the dead time.

        Args:
            line: the memory.
            seen: what the gateway wrote; without a sample another period has passed under what was commanded.
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
            # One that comes so late that nothing from before it is remembered begins anew.
            if sequence < 0 or seen.source != source or not 1.0 - most + REPORTED < periods <= most:
                written = [_Written(self._span, self._before(seen), False)]
                written += self._reported(seen, written)
            else:
                # A sample that comes late is of a period that was counted already.
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
        """The memory once an input, (m,), is on its way to the gateway."""
        return line if self.dead_time == 0.0 else {**line, "commanded": u}

    def _before(self, seen: Observation) -> np.ndarray:
        """What is taken to have been written before the first sample: what acts now, or else the safe input,
        without its gain."""
        u = acting(seen)
        return self._plant.safe_input - self._plant.u_e if u is None else u

    def _guessed(self, acting: np.ndarray, commanded: np.ndarray, delay: float) -> list[_Written]:
        """A period of which no sample tells: the command took over after the delay."""
        both = [_Written(delay, acting, False), _Written(self._period - delay, commanded, False)]
        return [one for one in both if one.seconds > 0.0]

    def _reported(self, seen: Observation, guess: list[_Written]) -> list[_Written]:
        """The period before a sample; what it does not tell, at the beginning of the period, is as `guess` has it."""
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
        """The last so many seconds; where there are fewer, its first input acted before."""
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
    """The input that the plant has when it is seen, (m,)."""
    return seen.pieces[-1][1] if seen.pieces else seen.applied


def predicted(
    model: Model, oracle: Oracle, state: OracleState, x: np.ndarray, inputs: Pieces
) -> tuple[np.ndarray, OracleState]:
    """Where `inputs` lead from x, (d,): the linear motion and h_hat, first a broken period and then whole ones.

    Returns:
        The state, (d,), and the oracle's state with the pairs of these whole periods in its past.
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
        # After a jump, or where it was not measured in time: only what acts now counts.
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
    """The first so many seconds, and the rest; a cut within a hair of a switch is at the switch."""
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
    """One for equal neighbours."""
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
