"""The time at which a message was sent, on the clock of its arrival."""

from __future__ import annotations

import math

import pytest

from protocol import codec, topics
from protocol import messages as m
from run_log.views.arrival import MOST_RUNS, LostTicks, SendTimes
from run_log.views.heads import StateHead, head_of

NAME = topics.PLANT_STATE.name
SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND


def state(t: float, run_id: str = "p") -> StateHead:
    return StateHead(run_id, 0, t, "command")


def test_the_quickest_message_gives_the_sending_time_of_late_ones() -> None:
    times = SendTimes()
    delays = [0.010, 0.002, 0.050, 0.002, 0.700]
    for k, delay in enumerate(delays):
        arrived = START + round((k + delay) * SECOND)
        sent = times.of(NAME, state(100.0 + k), arrived)
        quickest = min(delays[: k + 1])
        assert sent == pytest.approx(arrived - (delay - quickest) * SECOND, abs=2e5 * k + 1000)
        assert sent <= arrived


@pytest.mark.parametrize("t", [math.nan, math.inf, 1e22, -1e22])
def test_a_time_that_cannot_be_right_is_not_used(t: float) -> None:
    times = SendTimes()
    assert times.of(NAME, state(1.0), START) == START
    assert times.of(NAME, state(t), START + SECOND) == START + SECOND
    assert times.of(NAME, state(3.0), START + 2 * SECOND) == START + 2 * SECOND


def test_a_clock_that_was_set_back_is_followed_again() -> None:
    times = SendTimes()
    for k in range(3):
        times.of(NAME, state(1000.0 + k), START + k * SECOND)
    for k in range(3, 6):
        assert times.of(NAME, state(float(k)), START + k * SECOND) == START + k * SECOND


def test_a_tick_was_sent_when_it_really_began_and_others_have_no_time() -> None:
    times = SendTimes()
    tick = m.Tick.punctual("c", 0, 0.05, None)
    head = head_of(topics.TICK.name, codec.encode(tick))
    assert times.of(topics.TICK.name, head, START) == START
    timing = m.TickTiming(run_id="c", seq=0, solve_ms=1.0, tick_ms=1.0, lateness_ms=0.0, state_age_ms=0.0)
    assert times.of(topics.TIMING.name, timing, START + 5) == START + 5


def test_lost_ticks_are_counted_after_any_number_of_restarts() -> None:
    lost = LostTicks(follow_silence=1.0)
    for run in range(2 * MOST_RUNS):
        at = (10 * run) * SECOND
        assert lost.take(topics.TICK.name, f"c-{run}", 0, at) == 0
        assert lost.take(topics.TICK.name, f"c-{run}", 3, at + 1000) == 2
    assert lost.count == {topics.TICK.name: 4 * MOST_RUNS}
