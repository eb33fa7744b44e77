"""Slots lie on an absolute grid; missed ones are skipped and never run in a burst."""

from __future__ import annotations

import itertools
import threading

import pytest
from hypothesis import given
from hypothesis import strategies as st

from node_runtime.realtime import clock
from node_runtime.realtime.pacer import Grid, Pacer

PERIOD = 0.05


def run(grid: Grid, durations: list[float], start: float = 0.0) -> list[tuple[float, int, int]]:
    """Run steps that take `durations`; return the real start, the slot, and the skipped slots of each."""
    now, begun = start, []
    for duration in durations:
        slot = grid.next(now)
        now = max(now, slot.time)
        begun.append((now, slot.index, slot.skipped))
        now += duration
    return begun


def test_quick_steps_begin_exactly_on_the_grid() -> None:
    begun = run(Grid(PERIOD, 1.0), [0.01] * 1000)
    assert [time for time, _, _ in begun] == pytest.approx([1.0 + k * PERIOD for k in range(1000)], abs=1e-12)
    assert all(skipped == 0 for _, _, skipped in begun)


def test_a_slightly_late_step_is_run_at_once_and_the_grid_stays() -> None:
    begun = run(Grid(PERIOD, 0.0), [1.2 * PERIOD, 0.01, 0.01])
    assert [index for _, index, _ in begun] == [0, 1, 2]
    assert [time for time, _, _ in begun] == pytest.approx([0.0, 1.2 * PERIOD, 2 * PERIOD])


def test_missed_slots_are_skipped_and_counted() -> None:
    grid = Grid(PERIOD, 0.0)
    begun = run(grid, [4.7 * PERIOD, 0.01, 0.01])
    assert begun[1:] == [(pytest.approx(5 * PERIOD), 5, 4), (pytest.approx(6 * PERIOD), 6, 0)]
    assert grid.skipped == 4


@given(st.lists(st.floats(0.0, 1.0), min_size=1, max_size=60))
def test_never_a_burst(durations: list[float]) -> None:
    grid = Grid(PERIOD, 0.0)
    begun = run(grid, durations)
    gaps = [b[0] - a[0] for a, b in itertools.pairwise(begun)]
    assert all(gap >= 0.5 * PERIOD - 1e-9 for gap in gaps)
    # Every slot is either run or counted as skipped.
    assert begun[-1][1] == len(begun) - 1 + grid.skipped
    assert all(time >= index * PERIOD - 1e-9 for time, index, _ in begun)


@given(st.lists(st.floats(0.0, 1.0), min_size=1, max_size=60))
def test_slots_missed_during_a_sleep_are_skipped(oversleeps: list[float]) -> None:
    grid, now = Grid(PERIOD, 0.0), 0.0
    begun: list[tuple[float, int]] = []
    for oversleep in oversleeps:
        slot = grid.next(now)
        now = max(now, slot.time) + oversleep
        while (newer := grid.again(slot, now)) is not slot:
            slot, now = newer, max(now, newer.time)
        begun.append((now, slot.index))
    assert all(b[0] - a[0] >= 0.5 * PERIOD - 1e-9 for a, b in itertools.pairwise(begun))
    assert all(-1e-9 <= time - index * PERIOD <= 0.5 * PERIOD + 1e-9 for time, index in begun)
    assert begun[-1][1] == len(begun) - 1 + grid.skipped


def test_a_frozen_loop_continues_with_the_newest_slot() -> None:
    """SIGSTOP, or a host that takes the cores away, makes the thread sleep much longer than requested."""
    grid = Grid(PERIOD, 0.0)
    assert grid.next(0.0).index == 0
    slot = grid.next(0.01)
    assert (slot.index, slot.skipped) == (1, 0)
    late = grid.again(slot, 20.2 * PERIOD)
    assert (late.index, late.skipped) == (20, 19)
    assert grid.again(late, 20.2 * PERIOD) is late
    assert grid.next(20.3 * PERIOD).index == 21


@given(st.floats(-10.0, 10.0))
def test_slewing_reaches_the_phase_of_the_events_without_jumps(phase_of_events: float) -> None:
    grid = Grid(PERIOD, 0.0)
    now, due = 0.0, []
    for k in range(300):
        slot = grid.next(now)
        now = slot.time
        due.append(slot.time)
        grid.slew(phase_of_events + k * PERIOD, 0.001)
    gaps = [b - a for a, b in itertools.pairwise(due)]
    assert all(0.94 * PERIOD < gap < 1.06 * PERIOD for gap in gaps)
    assert abs(grid.slew(phase_of_events, 0.001)) < 1e-6


def test_a_new_anchor_skips_nothing() -> None:
    grid = Grid(PERIOD, 0.0)
    run(grid, [0.01] * 3)
    grid.reanchor(77.0)
    slot = grid.next(76.9)
    assert (slot.index, slot.skipped) == (3, 0)
    assert slot.time == pytest.approx(77.0)


def test_a_period_must_be_positive() -> None:
    with pytest.raises(ValueError, match="period"):
        Grid(0.0, 0.0)


def test_real_slots_do_not_drift() -> None:
    first = clock.now() + 0.01
    pacer = Pacer(Grid(0.01, first), threading.Event())
    for _ in range(30):
        turn = pacer.next()
        assert turn is not None
        slot, lateness = turn
        assert slot.time == pytest.approx(first + slot.index * 0.01, abs=1e-9)
        assert clock.now() - slot.time >= lateness >= 0.0


def test_a_long_sleep_ends_when_told_to_stop() -> None:
    stop = threading.Event()
    turns: list[object] = []
    pacer = Pacer(Grid(60.0, clock.now() + 60.0), stop)
    thread = threading.Thread(target=lambda: turns.append(pacer.next()))
    thread.start()
    stop.set()
    thread.join(30.0)
    assert turns == [None]
