"""Manual control in lock-step and in Python: the acting input, learning, the log, and that X is kept."""

from __future__ import annotations

import numpy as np
import pytest

from protocol import topics
from run_log.replaying.replay import replay
from tandem import Loop


@pytest.fixture(scope="module")
def loop() -> Loop:
    """40 periods under the controller, manual control until X would be left, 20 under the controller, 5 manual."""
    loop = Loop(config="compressor-cheap", train=False, oracle="constant")
    loop.run(40)
    loop.manual({"u": float(loop.plant.u_e[0]) + 0.2})
    while loop.by_hand:
        loop.step()
        assert loop._lockstep.taken < 300
    loop.run(20)
    loop.manual([1.1])
    loop.run(5)
    loop.auto()
    loop.run(5)
    return loop


def test_the_acting_input_is_reported_learned_and_shown(loop: Loop) -> None:
    result = loop.result
    states = result.run.plant_states
    by_hand = [state for state in states if state.source == "manual"]
    assert {state.applied[0] for state in by_hand if state.applied} == {1.1, float(loop.plant.u_e[0]) + 0.2}
    assert [state.source for state in states[-11:]] == ["command"] * 1 + ["manual"] * 5 + ["command"] * 5
    # Each of these periods has a label from the applied input.
    assert len(result.run.samples) == len(result.run.ticks) - 1
    spans = result.traces.motion.by_hand
    assert len(spans) == 2
    assert spans[1][1] - spans[1][0] == pytest.approx(5 * 0.05)


def test_x_is_kept_and_a_lease_is_renewed_in_time(loop: Loop) -> None:
    x, plant = loop.result.x, loop.plant
    room = np.minimum(x - plant.x_min, plant.x_max - x) / plant.x_scale
    assert room.min() > -1e-6
    said = [entry.message for entry in loop.result.run.entries(topics.OVERRIDE)]
    assert [message.mode for message in said[-2:]] == ["manual", "auto"]
    assert len({message.run_id for message in said}) == 3


def test_it_replays_byte_for_byte(loop: Loop) -> None:
    assert replay(loop.result.run).first_difference is None


def test_an_external_plant_gets_the_manual_input() -> None:
    loop = Loop(config="compressor-cheap", train=False, oracle="linear")
    for _ in range(3):
        loop.control(loop.plant.x_e)
    loop.manual([1.2])
    assert loop.control(loop.plant.x_e) == [1.2]
    loop.auto()
    assert loop.control(loop.plant.x_e) != [1.2]


@pytest.mark.parametrize("u", [[1.0, 2.0], [float("nan")], {"v": 1.0}])
def test_an_invalid_input_is_refused(loop: Loop, u: object) -> None:
    with pytest.raises(ValueError, match=r"is not an input|has no input"):
        loop.manual(u)
