"""The plant in virtual time, bit for bit: held, commanded, without commands."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lbmpc.plants import Plant, PlantError, Truth
from node_runtime.config.loading import override
from node_runtime.config.sections import Config
from plant_sim import node
from plant_sim.orders import Orders, Standby
from plant_sim.simulator import Motion, PlantSim
from protocol import messages as m
from tests.plant_sim.commands import PERIOD, PLANT, U, command


def backup(
    seq: int, inputs: list[float], run_id: str = "controller-a", period: float = PERIOD, gain: float = 0.5
) -> m.Backup:
    """Return the policy u = U + input + gain (z - z_e)."""
    offset = U - gain * float(PLANT.x_e[0])
    return m.Backup(
        run_id=run_id,
        seq=seq,
        period=period,
        gain=[[gain, 0.0, 0.0, 0.0]],
        inputs=[[offset + value] for value in inputs],
    )


def plant(x0: np.ndarray = PLANT.x0, period: float = PERIOD) -> PlantSim:
    return PlantSim(PLANT, Truth(PLANT), period, x0, 1.5, "plant-a")


def test_the_process_uses_the_true_plant() -> None:
    motion = node.motion_of(override(Config(), ["plant.truth.slope=1.4"]))
    motion.read(0.0)
    motion.write(PLANT.u_e, 0.0)
    true = Truth(PLANT.varied(slope=1.4))
    assert motion.read(PERIOD).tolist() == true.step(PLANT.x0, PLANT.u_e, PERIOD).tolist()


def test_the_plant_is_held_until_its_first_command() -> None:
    sim = plant()
    for k in range(5):
        state = sim.sample(k * PERIOD)
        assert (state.seq, state.x, state.applied) == (k, PLANT.x0.tolist(), None)
        assert (state.source, state.command_seq) == ("hold", -1)
    assert sim.sample(5 * PERIOD).pieces == []


# With a period of 0.03 s an average over the period would round, with 0.05 s it would not.
@pytest.mark.parametrize("period", [0.05, 0.03])
def test_lock_step_applies_each_input_exactly_for_its_period(period: float) -> None:
    sim, truth = plant(period=period), Truth(PLANT)
    x = PLANT.x0
    rng = np.random.default_rng(0)
    state = sim.sample(0.0)
    for k in range(60):
        u = U + float(rng.uniform(-0.05, 0.05))
        assert sim.command(command(k, u, answers=state.seq, period=period), k * period) == "ok"
        state = sim.sample((k + 1) * period)
        x = truth.step(x, np.array([u]), period)
        assert state.x == x.tolist()
        assert state.applied == [u]
        assert (state.source, state.command_seq, state.seq) == ("command", k, k + 1)


def test_an_input_in_the_middle_of_a_period_acts_from_there() -> None:
    sim, truth = plant(), Truth(PLANT)
    sim.sample(0.0)
    sim.command(command(0, 1.1), 0.0)
    sim.sample(PERIOD)
    sim.command(command(1, 1.3, answers=1), 1.2 * PERIOD)
    state = sim.sample(2 * PERIOD)
    x = truth.step(PLANT.x0, np.array([1.1]), PERIOD)
    x = truth.step(truth.step(x, np.array([1.1]), 0.2 * PERIOD), np.array([1.3]), 0.8 * PERIOD)
    assert state.x == pytest.approx(x.tolist(), abs=1e-10)
    assert state.applied == pytest.approx([0.2 * 1.1 + 0.8 * 1.3], abs=1e-12)


def test_the_period_in_which_the_plant_is_released_has_no_applied_input() -> None:
    sim = plant()
    sim.sample(0.0)
    sim.command(command(0, U, [U]), 0.3 * PERIOD)
    first = sim.sample(PERIOD)
    assert first.applied is None
    # The present input is known, so that the response can be predicted.
    assert [piece.u for piece in first.pieces] == [[U]]
    assert first.pieces[0].seconds == pytest.approx(0.7 * PERIOD)
    assert sim.sample(2 * PERIOD).applied == [U]
    assert plant().sample(0.0).pieces == []


def test_without_commands_the_plan_and_then_the_safe_input() -> None:
    sim = plant(PLANT.x_e)
    sim.sample(0.0)
    sim.command(command(0, U + 0.01, [U + 0.02, U + 0.03, U + 0.04]), 0.0)
    states = [sim.sample(k * PERIOD) for k in range(1, 8)]
    assert [state.source for state in states] == ["command", "plan", "plan", "plan", "safe", "safe", "safe"]
    # The first entry acts for the patience of 1.5 periods, which includes half of the second period.
    applied = [state.applied[0] - U for state in states if state.applied]
    assert applied[:4] == pytest.approx([0.01, 0.015, 0.03, 0.04], abs=1e-12)
    assert PLANT.safe_gain is not None
    for before, u in zip(states[3:], applied[4:], strict=False):
        assert u == pytest.approx(float((PLANT.safe_gain @ (np.array(before.x) - PLANT.x_e))[0]), abs=1e-12)
    assert all(state.command_seq == 0 for state in states)


def test_without_commands_the_backup_policy_uses_the_plants_measurements() -> None:
    sim, truth = plant(), Truth(PLANT)
    sim.sample(0.0)
    sim.command(command(0, U, [U + 0.5] * 4), 0.0)
    assert sim.backup(backup(0, [0.01, 0.02])) == "ok"
    states = [sim.sample(k * PERIOD) for k in range(1, 5)]
    assert [state.source for state in states] == ["command", "plan", "plan", "plan"]
    x = truth.step(truth.step(PLANT.x0, np.array([U]), PERIOD), np.array([U]), PERIOD / 2)
    # Entry 0 belongs to the second period; for half of it the command was still expected.
    u = np.array([U + 0.01 + 0.5 * (x[0] - PLANT.x_e[0])])
    x = truth.step(x, u, PERIOD / 2)
    assert states[1].x == pytest.approx(x.tolist(), abs=1e-10)
    u = np.array([U + 0.02 + 0.5 * (x[0] - PLANT.x_e[0])])
    assert states[2].applied == pytest.approx(u.tolist(), abs=1e-10)
    # After its last entry the plan continues with its own entry for that period.
    assert states[3].applied == [U + 0.5]


def test_the_previous_backup_is_used_until_the_new_one_arrives() -> None:
    def applied(backups: int) -> list[float]:
        """Return the inputs over the fourth and fifth period, after three commands a fifth of a period late."""
        sim = plant(PLANT.x_e)
        for k in range(3):
            sim.sample(k * PERIOD)
            sim.command(command(k, U, [U + 0.3] * 9, answers=k), (k + 0.2) * PERIOD)
            if k < backups:
                assert sim.backup(backup(k, [0.01, 0.02, 0.03, 0.04], gain=0.0)) == "ok"
        sim.sample(3 * PERIOD)
        states = [sim.sample(4 * PERIOD), sim.sample(5 * PERIOD)]
        return [state.applied[0] - U for state in states if state.applied]

    # Command 2 acts until 3.7, followed by the entries of command 1 for its periods from 3.2 and 4.2 on.
    assert applied(backups=2) == pytest.approx([0.3 * 0.02, 0.2 * 0.02 + 0.8 * 0.03], abs=1e-12)
    # The policy of two commands ago is not used.
    assert applied(backups=1) == pytest.approx([0.3 * 0.3, 0.3], abs=1e-12)


def test_a_backup_without_its_command_is_refused() -> None:
    sim = plant(PLANT.x_e)
    assert sim.backup(backup(0, [0.0])) == "foreign"
    sim.sample(0.0)
    sim.command(command(5, U, [U] * 3), 0.0)
    assert sim.backup(backup(5, [0.0], period=1.0)) == "wrong period"
    assert sim.backup(backup(4, [0.0])) == "stale"
    assert sim.backup(backup(5, [0.0], run_id="controller-b")) == "foreign"
    assert sim.backup(backup(5, [0.0])) == "ok"


def test_a_backup_whose_numbers_overflow_leaves_the_plant_to_the_plan() -> None:
    sim = plant(PLANT.x_e)
    sim.sample(0.0)
    sim.command(command(0, U, [U + 0.1] * 3), 0.0)
    huge = msgspec.structs.replace(backup(0, [0.0, 0.0]), gain=[[1e308, 1e308, -1e308, 1e308]])
    assert sim.backup(msgspec.structs.replace(huge, inputs=[[-1e308], [1e308]])) == "ok"
    sim.sample(PERIOD)
    assert sim.sample(2 * PERIOD).applied == pytest.approx([U + 0.05], abs=1e-12)


@pytest.mark.parametrize("period", [0.1, 0.05, 0.01])
def test_the_safe_input_brings_the_compressor_back(period: float) -> None:
    """With a constant input it would go into surge, because the equilibrium is unstable."""

    def after(plant: Plant) -> float:
        x0 = PLANT.x_e + np.array([-0.1, 0.0, 0.0, 0.0])
        sim = PlantSim(plant, Truth(plant), period, x0, 1.5, "plant-a")
        sim.sample(0.0)
        sim.command(command(0, U, period=period), 0.0)
        for k in range(1, round(10 / period)):
            state = sim.sample(k * period)
        assert state.source == "safe"
        return float(np.abs(np.array(state.x) - PLANT.x_e).max())

    assert after(PLANT) < 0.01
    assert after(replace(PLANT, safe_gain=None)) > 0.1


def test_a_fresh_command_ends_the_plan() -> None:
    sim = plant(PLANT.x_e)
    sim.sample(0.0)
    sim.command(command(0, U, [U] * 3), 0.0)
    for k in range(1, 4):
        state = sim.sample(k * PERIOD)
    assert state.source == "plan"
    sim.command(command(9, U + 0.01, answers=3), 3 * PERIOD)
    state = sim.sample(4 * PERIOD)
    assert (state.source, state.applied, state.command_seq) == ("command", [U + 0.01], 9)


@given(
    st.floats(1.0, 6.0),
    st.integers(0, 8),
    st.integers(0, 8),
    st.floats(0.0, 1e7),
    st.floats(0.001, 10.0),
    st.sampled_from([None, PLANT.safe_gain]),
)
def test_the_source_of_the_input_always_advances(
    patience: float, entries: int, backups: int, arrived: float, period: float, gain: np.ndarray | None
) -> None:
    held = replace(PLANT, safe_gain=gain)
    orders = Orders(held, command(0, U, [U] * entries, period=period), arrived, patience)
    standby = Standby(backup(0, [0.0] * backups, period=period), arrived) if backups else None
    t, sources = arrived, []
    while np.isfinite(t):
        drive = orders.drive(t, lambda: PLANT.x_e, standby)
        assert drive.until > t
        sources.append(drive.source)
        t = drive.until
        if (gain is not None and sources.count("safe") > 3) or len(sources) > 3 + max(entries, backups):
            break
    assert sources[0] == "command"
    assert sources[-1] == "safe"
    safe = sources.index("safe")
    assert sources[1:safe] == ["plan"] * (safe - 1)
    assert sources[safe:] == ["safe"] * (len(sources) - safe)


def test_the_clipped_input_is_reported() -> None:
    sim = plant(PLANT.x_e)
    sim.sample(0.0)
    sim.command(command(0, 99.0, [-99.0] * 5), 0.0)
    assert sim.sample(PERIOD).applied == PLANT.u_max.tolist()
    assert sim.sample(3 * PERIOD).applied is None  # one sample was missed
    state = sim.sample(4 * PERIOD)
    assert (state.applied, state.source, state.seq) == (PLANT.u_min.tolist(), "plan", 4)


def test_invalid_commands_are_refused() -> None:
    sim = plant()
    assert sim.command(command(0, U), 0.0) == "foreign"  # there is no sample yet
    sim.sample(0.0)
    assert sim.command(command(0, U, run_id="plant-b"), 0.0) == "foreign"
    assert sim.command(command(0, U, answers=1), 0.0) == "foreign"
    assert sim.command(command(0, U, answers=-1, run_id=""), 0.0) == "answers no sample"
    assert sim.command(command(0, U, period=3000.0), 0.0) == "wrong period"
    assert not sim.sample(PERIOD).command_seq >= 0
    assert sim.command(command(0, U, answers=1), PERIOD) == "ok"
    assert sim.sample(2 * PERIOD).source == "command"
    # The same holds for a moving plant: the plan of a controller without states is worse than the plant's policy.
    assert sim.command(command(1, U, answers=-1, run_id=""), PERIOD) == "answers no sample"
    assert sim.sample(3 * PERIOD).command_seq == 0


def test_old_commands_in_a_burst_are_refused() -> None:
    sim = plant(PLANT.x_e)
    sim.sample(0.0)
    sim.command(command(0, U), 0.0)
    for k in range(1, 61):
        sim.sample(k * PERIOD)
    burst = 60.5 * PERIOD
    verdicts = [sim.command(command(k, U, answers=k), burst) for k in range(1, 61)]
    assert verdicts == ["stale"] * 57 + ["ok"] * 3


def test_looking_at_the_next_sample_changes_nothing() -> None:
    def states(looked: bool) -> list[m.PlantState]:
        sim, found = plant(), []
        for k in range(6):
            ahead = sim.look(k * PERIOD) if looked else None
            found.append(sim.sample(k * PERIOD))
            assert ahead in (None, found[-1])
            if k < 3:
                sim.command(command(k, U + 0.01 * k, [U] * 2, answers=k), (k + 0.2) * PERIOD)
        return found

    assert states(looked=True) == states(looked=False)


def test_looking_ahead_changes_nothing() -> None:
    def states(ahead: bool) -> list[list[float]]:
        motion, rng, found = Motion(Truth(PLANT), PLANT.x0, PERIOD), np.random.default_rng(1), []
        for k in range(30):
            found.append(motion.read(1e5 + k * PERIOD).tolist())
            if k % 7 < 5:
                motion.write(
                    np.array([U + rng.uniform(-0.05, 0.05)]), 1e5 + (k + rng.uniform(0.0, 0.9)) * PERIOD
                )
            if ahead:
                motion.look_ahead()
        return found

    assert states(ahead=True) == states(ahead=False)


def test_a_sample_computed_ahead_is_not_computed_again() -> None:
    truth, steps = Truth(PLANT), []

    class Counted:
        def step(self, x: np.ndarray, u: np.ndarray, dt: float) -> np.ndarray:
            steps.append(dt)
            return truth.step(x, u, dt)

    motion = Motion(Counted(), PLANT.x0, PERIOD)
    for k in range(5):
        # The grid has large times with the rounding of a clock.
        motion.read(26000.123456789 + k * PERIOD)
        before = len(steps)
        motion.write(PLANT.u_e, 26000.123456789 + (k + 0.1) * PERIOD)
        motion.look_ahead()
        assert len(steps) == before + (2 if k else 1)
    assert len(steps) == 9


def test_a_motion_that_cannot_be_computed_is_an_error() -> None:
    sim = plant(np.array([-1.6, 0.05, 2.0, 0.0]))
    sim.sample(0.0)
    sim.command(command(0, float(PLANT.u_max[0]), [float(PLANT.u_max[0])] * 60), 0.0)
    with pytest.raises(PlantError, match="pressure y"):
        sim.sample(PERIOD * 10)


def test_an_input_acts_a_dead_time_later_also_within_a_period() -> None:
    late, truth = 1.3 * PERIOD, Truth(PLANT)
    motion = Motion(truth, PLANT.x0, PERIOD, late, PLANT.safe_input)
    first, second = np.array([1.1]), np.array([1.3])
    assert motion.read(0.0).tolist() == PLANT.x0.tolist()
    motion.write(first, 0.2 * PERIOD)
    motion.look_ahead()
    motion.read(PERIOD)
    motion.write(second, 1.2 * PERIOD)
    motion.look_ahead()
    found = motion.read(3 * PERIOD)
    # The plant stands still until the first write, and then moves under the earlier input until the new one acts.
    x = PLANT.x0
    for u, seconds in ((PLANT.safe_input, 1.3), (first, 1.0), (second, 0.5)):
        x = truth.step(x, u, seconds * PERIOD)
    np.testing.assert_allclose(found, x, rtol=1e-9, atol=1e-9)


def test_looking_ahead_changes_nothing_with_a_dead_time_of_whole_periods() -> None:
    truth, steps = Truth(PLANT), []

    class Counted:
        def step(self, x: np.ndarray, u: np.ndarray, dt: float) -> np.ndarray:
            steps.append(dt)
            return truth.step(x, u, dt)

    def states(ahead: bool) -> list[list[float]]:
        motion, found = Motion(Counted(), PLANT.x0, PERIOD, 2 * PERIOD, PLANT.safe_input), []
        for k in range(12):
            due = 1e5 + k * PERIOD
            found.append(motion.read(due).tolist())
            motion.write(np.array([U + 0.01 * (k % 5)]), due + (0.6 * PERIOD if k % 4 < 2 else 0.0))
            if ahead:
                motion.look_ahead()
        return found

    found, worked_out = states(ahead=True), steps.copy()
    steps.clear()
    assert states(ahead=False) == found
    # Nothing is computed that another input makes invalid; the last sample is never read.
    assert len(worked_out) <= len(steps) + 1
