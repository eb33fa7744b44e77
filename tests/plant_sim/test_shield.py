"""The shield at a real machine: its writes and its samples; no clock, no process."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from plant_sim.shield import MOST_ACTED, Shield
from protocol import messages as m
from tests.plant_sim.commands import PERIOD, PLANT, U, planned

AWAY = PLANT.x_e + np.array([0.1, 0.0, 0.0, 0.0])


class Bench:
    """A machine at `x` that takes `takes` seconds for a write and fails if told to."""

    def __init__(self, **options: object):
        self.shield = Shield(replace(PLANT, **options), PERIOD, 1.5, "plant-a", held=False)
        self.x: np.ndarray | None = AWAY
        self.takes = 0.0
        self.fails = False
        self.reads: list[float] = []
        self.writes: list[tuple[float, float]] = []

    def read(self, due: float) -> np.ndarray | None:
        self.reads.append(due)
        return self.x

    def write(self, u: np.ndarray, due: float) -> float | None:
        self.writes.append((due, float(u[0])))
        return None if self.fails else due + self.takes

    def sample(self, k: float, late: float = 0.0) -> m.PlantState | None:
        """Do what a gateway does at slot k; x is measured `late` seconds after it."""
        t = k * PERIOD
        self.act(t)
        state = None if self.x is None else self.shield.sample(t, self.x, t + late)
        self.shield.renew(t, self.x, self)
        return state

    def sampled(self, k: float, late: float = 0.0) -> m.PlantState:
        state = self.sample(k, late)
        assert state is not None
        return state

    def command(self, seq: int, at: float, u: float = U, plan: int = 3) -> str:
        """Send a command and let it act."""
        verdict = self.sent(seq, at, u, plan)
        self.act(at * PERIOD)
        return verdict

    def sent(self, seq: int, at: float, u: float, plan: int) -> str:
        """Send a command for sample `seq` that arrives at time `at` in periods; its plan is u + 0.01, u + 0.02, .."""
        entries = [[u + 0.01 * i] for i in range(1 + plan)]
        return self.shield.command(planned(seq, entries, seq), at * PERIOD)

    def backup(self, seq: int, inputs: list[float], gain: float = 0.0) -> str:
        return self.shield.backup(
            m.Backup(
                run_id="controller-a",
                seq=seq,
                period=PERIOD,
                gain=[[gain, 0.0, 0.0, 0.0]],
                inputs=[[u] for u in inputs],
            )
        )

    def act_until(self, t: float) -> None:
        """Apply all inputs that are due by then, each at its own time."""
        self.shield.advance(t, self)

    def act(self, t: float) -> None:
        if self.shield.due <= t:
            self.shield.act(t, self)


def fed_back(x: np.ndarray) -> float:
    """Return the safe input in this state."""
    assert PLANT.safe_gain is not None
    return float((PLANT.safe_input + PLANT.safe_gain @ (x - PLANT.x_e))[0])


def test_a_machine_that_cannot_be_held_starts_with_its_safe_input() -> None:
    bench = Bench()
    first, second = bench.sampled(0), bench.sampled(1)
    assert (first.applied, first.pieces) == (None, [])
    assert bench.writes == [(0.0, fed_back(AWAY)), (PERIOD, fed_back(AWAY))]
    # The acting input is known, so this gives a label, although there was no command.
    assert (second.applied, second.source, second.command_seq) == ([fed_back(AWAY)], "safe", -1)
    assert not bench.shield.moving


def test_the_safe_feedback_uses_the_state_if_there_is_one() -> None:
    bench = Bench()
    bench.sample(0)
    bench.x = PLANT.x_e + np.array([-0.2, 0.0, 0.0, 0.0])
    bench.sample(1)
    bench.x = None
    assert bench.sample(2) is None
    bench.x = np.full(4, 1e308)
    bench.sample(3)
    given = [u for _due, u in bench.writes]
    assert given[1] == fed_back(PLANT.x_e + np.array([-0.2, 0.0, 0.0, 0.0])) != given[0]
    assert given[2] == float(PLANT.safe_input[0])
    assert PLANT.u_min[0] <= given[3] <= PLANT.u_max[0]


def test_without_bounds_the_safe_feedback_is_never_infinite() -> None:
    bench = Bench(u_min=[-np.inf], u_max=[np.inf], scale={"v": 1.0})
    bench.x = np.full(4, 1e308)
    bench.sample(0)
    assert np.isfinite(bench.writes[0][1])


def test_a_command_acts_from_its_arrival_which_the_sample_reports() -> None:
    bench = Bench()
    bench.sample(0)
    assert bench.command(0, 0.2) == "ok"
    assert bench.writes[-1] == (0.2 * PERIOD, U)
    state = bench.sampled(1)
    assert [piece.seconds for piece in state.pieces] == pytest.approx([0.2 * PERIOD, 0.8 * PERIOD])
    assert [piece.u for piece in state.pieces] == [[fed_back(AWAY)], [U]]
    assert state.applied == pytest.approx([0.2 * fed_back(AWAY) + 0.8 * U])
    assert (state.source, state.command_seq) == ("command", 0)


def test_an_input_acts_when_the_write_has_returned() -> None:
    bench = Bench()
    bench.takes = 0.1 * PERIOD
    bench.sample(0)
    bench.command(0, 0.2)
    assert [piece.seconds for piece in bench.sampled(1).pieces][-1] == pytest.approx(0.7 * PERIOD)


def test_a_write_that_returns_in_the_next_period_belongs_to_it() -> None:
    bench = Bench(safe_gain=None)
    bench.sample(0)
    bench.takes = 0.5 * PERIOD
    bench.command(0, 0.8, u=U + 0.02)
    assert bench.sampled(1).applied == PLANT.safe_input.tolist()
    state = bench.sampled(2)
    assert [piece.seconds for piece in state.pieces] == pytest.approx([0.3 * PERIOD, 0.7 * PERIOD])
    assert [piece.u for piece in state.pieces] == [PLANT.safe_input.tolist(), [U + 0.02]]


def test_writes_are_less_than_two_periods_apart() -> None:
    bench = Bench(safe_gain=None)
    for k in range(4):
        bench.sample(k)
        bench.command(k, k + 0.2)
    # With a command in each period there are no other writes.
    assert [due / PERIOD for due, _u in bench.writes] == pytest.approx([0.0, 0.2, 1.2, 2.2, 3.2])
    for k in range(4, 16):
        bench.sample(k)
    dues = [due / PERIOD for due, _u in bench.writes]
    assert max(after - before for before, after in pairwise(dues)) < 2.0
    assert [u for _due, u in bench.writes[-7:]] == [float(PLANT.safe_input[0])] * 7


def test_after_a_failed_write_the_input_is_unknown_until_one_succeeds() -> None:
    bench = Bench()
    bench.sample(0)
    bench.fails = True
    bench.command(0, 0.2)
    state = bench.sampled(1)
    assert (state.applied, state.pieces) == (None, [])
    # The write is repeated at once, and not only with the next command.
    assert bench.writes[-1] == (PERIOD, U)
    bench.fails = False
    assert bench.sampled(2).applied is None
    assert bench.sampled(3).applied == [U + 0.01]


def test_without_a_measurement_there_is_no_sample_and_no_label_across_the_gap() -> None:
    bench = Bench()
    bench.sample(0)
    bench.command(0, 0.0, plan=9)
    assert bench.sampled(1).applied == [U]
    bench.x = None
    assert bench.sample(2) is None
    bench.x = AWAY
    state = bench.sampled(3)
    assert (state.seq, state.applied) == (3, None)
    assert bench.sampled(4).applied is not None


def test_inputs_are_forgotten_after_a_long_time_without_samples() -> None:
    bench = Bench()
    bench.sample(0)
    bench.x = None
    for k in range(1, 3 * MOST_ACTED):
        bench.sample(k)
    assert len(bench.shield._tape) <= MOST_ACTED
    bench.x = AWAY
    state = bench.sampled(3 * MOST_ACTED)
    assert state.applied is None
    assert state.pieces[-1].u == PLANT.safe_input.tolist()
    assert bench.sampled(3 * MOST_ACTED + 1).applied is not None


def test_the_policy_reads_at_the_start_of_its_periods_and_without_a_state_the_plan_acts() -> None:
    bench = Bench()
    bench.sample(0)
    bench.command(0, 0.2)
    assert bench.backup(0, [U, U + 0.05, U + 0.07], gain=0.5) == "ok"
    bench.sample(1)
    assert bench.reads == []
    # The patience ends at 1.7; the policy's periods begin at 1.2, 2.2 and so on.
    bench.act(1.7 * PERIOD + 1e-9)
    bench.sample(2)
    bench.act(2.2 * PERIOD + 1e-9)
    assert [due / PERIOD for due in bench.reads] == pytest.approx([1.7, 2.2])
    assert bench.writes[-1][1] == U + 0.05 + 0.5 * AWAY[0]
    bench.x = None
    bench.sample(3)
    assert bench.writes[-1] == (3 * PERIOD, U + 0.02)


@pytest.mark.parametrize("late", [0.02, 0.3])
def test_a_late_measurement_gives_no_label(late: float) -> None:
    bench = Bench()
    bench.sample(0)
    bench.command(0, 0.0, plan=9)
    states = [bench.sampled(k, late * PERIOD if k == 2 else 0.0) for k in range(1, 5)]
    # Neither this sample nor the next has a label, because both periods had another length.
    assert [state.applied is None for state in states] == [False, late > 0.1, late > 0.1, False]
    assert all(state.pieces for state in states if state.applied is None)


def test_after_a_standstill_only_the_present_input_is_written() -> None:
    bench = Bench()
    bench.sample(0)
    bench.command(0, 0.2, plan=40)
    before = len(bench.writes)
    bench.sample(30)
    # There is no burst of thirty entries.
    assert [u for _due, u in bench.writes[before:]] == pytest.approx([U + 0.29])


def jumped(after_command: Callable[[Bench], None] = lambda bench: None) -> tuple[Bench, m.PlantState]:
    """Return a machine whose state jumps after its second sample, and the third sample, the first of the new epoch."""
    bench = Bench()
    bench.sample(0)
    bench.command(0, 0.2)
    bench.sample(1)
    bench.command(1, 1.2)
    after_command(bench)
    bench.shield.jump()
    return bench, bench.sampled(2)


def test_after_a_jump_only_the_present_input_is_known() -> None:
    bench, state = jumped()
    assert (state.seq, state.applied, state.source) == (2, None, "command")
    assert state.pieces == [m.Piece(0.0, [U])]
    after = bench.sampled(3)
    assert (after.seq, after.applied is None) == (3, False)


def test_commands_for_samples_before_a_jump_are_not_followed() -> None:
    bench, _state = jumped(lambda bench: None)
    assert bench.command(1, 2.1) == "stale"
    assert bench.backup(1, [U] * 3) == "stale"
    # The input acts until the patience ends; its plan was made for another state.
    assert (bench.writes[-1][1], bench.shield.due) == (U, pytest.approx(2.7 * PERIOD))
    before = len(bench.writes)
    for k in range(3, 6):
        bench.sample(k)
    assert {u for _due, u in bench.writes[before:]} == {fed_back(AWAY)}
    assert bench.command(5, 5.1, u=U + 0.02) == "ok"
    assert bench.backup(5, [U] * 3) == "ok"
    assert bench.writes[-1][1] == U + 0.02


def test_a_policy_from_before_a_jump_is_not_followed() -> None:
    bench, _state = jumped(lambda bench: bench.backup(1, [U + 0.3] * 9) and None)
    before = len(bench.writes)
    for k in range(3, 6):
        bench.sample(k)
    assert {u for _due, u in bench.writes[before:]} == {fed_back(AWAY)}


def test_a_jump_ends_a_plan_at_once() -> None:
    bench = Bench()
    bench.sample(0)
    bench.command(0, 0.2, plan=9)
    for k in range(1, 4):
        bench.sample(k)
    assert bench.sampled(4).source == "plan"
    bench.shield.jump()
    bench.sample(5)
    assert bench.writes[-1] == (5 * PERIOD, fed_back(AWAY))


def test_a_pending_command_is_dropped_at_a_jump() -> None:
    bench = Bench()
    bench.sample(0)
    bench.command(0, 0.0)
    bench.sample(1)
    bench.shield.jump()
    # The command was accepted but does not act yet when the sample is taken.
    assert bench.sent(1, 2.1, 1.0, 0) == "ok"
    bench.sample(2)
    bench.act(2.2 * PERIOD)
    assert all(u != 1.0 for _due, u in bench.writes)


def test_the_last_input_is_the_safe_one_within_its_bounds() -> None:
    assert Bench().shield.rest() == PLANT.safe_input
    rest = Bench(safe_input=[99.0]).shield.rest()
    assert rest is not None
    assert rest.tolist() == PLANT.u_max.tolist()
    assert Shield(PLANT, PERIOD, 1.5, "plant-a", held=True).rest() is None
