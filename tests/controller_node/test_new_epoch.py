"""A plant whose state jumps: its gateway reports it, and the controller skips the label and continues."""

from __future__ import annotations

import numpy as np
import pytest

from controller_node.core import ControllerCore
from node_runtime.config.loading import override
from node_runtime.config.sections import Config
from run_log.replaying.replay import replay
from run_log.run import Run
from tandem.experiments.simulation.faults import Faults
from tandem.experiments.simulation.lockstep import LockStep

JUMP, STEPS, EVERY = 10, 20, 4
SETTINGS = (
    "controller.horizon=10",
    "controller.solver.compile=never",
    f"controller.keyframe_every={EVERY}",
    "network.hidden=[8, 8]",
    "trainer.enabled=false",
)
AWAY = np.array([0.05, 0.02, 0.0, 0.0])


def jumping(oracle: str, told: bool) -> tuple[LockStep, Run]:
    """Return a run whose plant jumps at tick `JUMP`; `told` says whether its gateway reports it."""
    loop = LockStep(
        override(Config(), [*SETTINGS, f"controller.oracle={oracle}"]), Faults(command_seconds=0.004)
    )
    for k in range(STEPS):
        if k != JUMP:
            loop.step()
            continue
        if told:
            # `Gateway.new_epoch` does the same.
            loop.plant._shield.jump()
        loop.step(loop.core.plant.x_e + AWAY)
    return loop, loop.so_far()


@pytest.fixture(scope="module", params=["dnn", "l2nw"])
def run(request: pytest.FixtureRequest) -> tuple[LockStep, Run]:
    return jumping(request.param, told=True)


def test_no_label_spans_the_jump_and_the_next_is_right(run: tuple[LockStep, Run]) -> None:
    loop, ran = run
    # The plant was held for part of the first period.
    assert [result.seq for result in ran.results if result.h is None] == [0, 1, JUMP]
    assert JUMP - 1 not in {sample.seq for sample in ran.samples}
    model, plant = loop.core.controller.model, loop.core.plant
    before, after = (np.array(ran.ticks[k].state.x) - plant.x_e for k in (JUMP, JUMP + 1))
    state = ran.ticks[JUMP + 1].state
    assert state is not None
    pieces = [(piece.seconds, np.array(piece.u) - plant.u_e) for piece in state.pieces]
    h = model.label(before, np.array(state.applied) - plant.u_e, after, tuple(pieces))
    assert ran.results[JUMP + 1].h == pytest.approx(h.tolist(), abs=1e-12)
    # All labels are small, so the jump itself is not among them.
    largest = max(max(map(abs, result.h)) for result in ran.results if result.h is not None)
    assert largest < 0.1 * np.abs(AWAY).max()


def test_the_input_at_the_jump_is_known_and_used_for_the_prediction(
    run: tuple[LockStep, Run],
) -> None:
    _loop, ran = run
    results, states = ran.results, [tick.state for tick in ran.ticks]
    jumped, before = states[JUMP], states[JUMP - 1]
    assert jumped is not None
    assert before is not None
    assert (jumped.run_id, jumped.seq) == (before.run_id, before.seq + 1)
    assert [piece.u for piece in jumped.pieces] == [ran.commands[JUMP - 1].u]
    assert results[JUMP].input_delay == results[JUMP - 1].input_delay > 0.0


def test_an_unreported_jump_would_be_learned() -> None:
    """The rule matters: without it the controller takes the jump as the plant's own motion."""
    _loop, ran = jumping("l2nw", told=False)
    h = ran.results[JUMP].h
    assert h is not None
    assert max(map(abs, h)) > 0.1 * np.abs(AWAY).max()


@pytest.mark.parametrize("from_tick", [None, JUMP, JUMP + 1])
def test_a_log_with_a_jump_replays_byte_for_byte(run: tuple[LockStep, Run], from_tick: int | None) -> None:
    _loop, ran = run
    replayed = replay(ran, from_tick)
    assert replayed.equal
    assert replayed.lost_ticks == 0


def test_a_controller_restarted_at_the_jump_continues_with_its_memory(run: tuple[LockStep, Run]) -> None:
    loop, ran = run
    ahead = LockStep(loop.config, loop.faults)
    for _ in range(JUMP):
        ahead.step()
    ahead.plant._shield.jump()
    ahead.step(loop.core.plant.x_e + AWAY)
    other = ControllerCore(loop.config, "controller-other")
    other.memory.go_on(ahead.core.memory.lasting(), "controller-before")
    first = other.step(ran.ticks[JUMP + 1])
    second = other.step(ran.ticks[JUMP + 2])
    # Its first sample has no predecessor, so learning starts with the second.
    assert first.sample is None
    assert second.sample is not None
    assert second.result.h == ran.results[JUMP + 2].h
