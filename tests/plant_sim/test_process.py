"""The plant as a real process: it continues without commands, ends cleanly, and reports the reason."""

from __future__ import annotations

import signal
from itertools import groupby, pairwise

import msgspec
import pytest

from node_runtime.bus.zenoh_bus import Bus
from node_runtime.router import open_router
from plant_sim import node
from protocol import messages as m
from protocol import topics
from tests.helpers.live import BusListener, Process, health_of, live_config, matched, wait_for
from tests.plant_sim.commands import PLANT, U, command


@pytest.mark.live
def test_a_real_plant_continues_without_commands_and_ends_cleanly() -> None:
    # The foreign sender must not take over, however slow this machine is.
    config = live_config("plant.x0=[0.5, 1.6875, 1.1547, 0.0]", "bus.follow_silence=60.0")
    with open_router(config), Bus(config, "controller", "controller-a") as bus:
        ear = BusListener(bus)
        with Process("plant_sim.node", config) as process:
            ear.until(health_of("plant", status="ready", note="held at x0 until the first command"))
            second = Bus(config, "controller", "controller-b")
            second.open()
            wait_for(lambda: matched(bus, topics.COMMAND) and matched(second, topics.COMMAND))
            for k in range(6):
                # The foreign sender begins when the plant follows the first one: its command may be quicker.
                ear.of(topics.PLANT_STATE)
                seen = ear.until(_follows if k else _holds)
                assert isinstance(seen, m.PlantState)
                answer = command(k, U + 0.01, [U] * 40, answers=seen.seq, run_id=seen.run_id)
                bus.publish(topics.COMMAND, answer)
                if k:
                    second.publish(topics.COMMAND, msgspec.structs.replace(answer, run_id="b", u=[9.0]))
            ear.until(health_of("plant", note="no fresh command and nothing left to follow: safe input"))
            foreign = "bad_controller_command_foreign"
            ear.until(lambda message: isinstance(message, m.Health) and message.counters.get(foreign) == 5)
            process.signal(signal.SIGINT)
            ear.until(health_of("plant", status="stopping"))
            assert process.end() == 0
            second.close()
    states = ear.of(topics.PLANT_STATE)
    order = [source for source, _ in groupby(state.source for state in states)]
    assert order[0] == "hold"
    assert "command" in order
    assert order[-2:] == ["plan", "safe"]
    # If this test is delayed for longer than a plan, a period may begin with the safe input.
    driven = [after for before, after in pairwise(states) if "safe" not in (before.source, after.source)]
    applied = {state.applied[0] for state in driven if state.applied}
    assert applied
    assert all(U - 1e-9 <= u <= U + 0.01 + 1e-9 for u in applied)
    seqs = [state.seq for state in states]
    assert seqs == sorted(set(seqs))


def _holds(message: m.Message) -> bool:
    return isinstance(message, m.PlantState) and message.source == "hold"


def _follows(message: m.Message) -> bool:
    return isinstance(message, m.PlantState) and message.source != "hold"


@pytest.mark.live
def test_a_plant_whose_motion_ends_logs_the_reason() -> None:
    config = live_config("rate=50.0", "plant.x0=[-1.6, 0.05, 2.0, 0.0]")
    high = float(PLANT.u_max[0])
    with open_router(config), Bus(config, "controller", "controller-a") as bus:
        ear = BusListener(bus)
        with Process("plant_sim.node", config) as process:
            failed = health_of("plant", status="failed")
            wait_for(lambda: matched(bus, topics.COMMAND))
            health, seq = None, 0
            # Repeat until a command is in time, because a command for an old state is refused.
            while not isinstance(health, m.Health):
                health = ear.until(lambda message: isinstance(message, m.PlantState) or failed(message))
                if isinstance(health, m.PlantState):
                    bus.publish(
                        topics.COMMAND,
                        command(
                            seq, high, [high] * 60, answers=health.seq, run_id=health.run_id, period=0.02
                        ),
                    )
                    seq += 1
            assert "pressure y" in health.note
            assert process.end() == 3
            assert "Traceback" not in process.said
            assert "pressure y" in process.said


def test_a_wrong_plant_gives_a_readable_error(caplog: pytest.LogCaptureFixture) -> None:
    assert node.main(live_config('plant.model="moore"')) == 2
    assert node.main(live_config("plant.x0=[1.0]")) == 2
    assert "did you mean 'moore_greitzer'?" in caplog.text
    assert "plant.x0 has 1 entries; moore_greitzer has 4 states (z, y, r, rdot)" in caplog.text


@pytest.mark.live
def test_a_plant_without_a_router_can_be_stopped() -> None:
    config = live_config()
    with Process("plant_sim.node", config) as process:
        wait_for_words(process, "waiting for it")
        process.signal(signal.SIGTERM)
        assert process.end() == 0
        assert "Traceback" not in process.said


def wait_for_words(process: Process, words: str) -> None:
    """Read the process's output up to a line with these words."""
    for line in process.lines():
        if words in line:
            return
    raise AssertionError(f"the process never said {words!r}")
