"""The controller with a scripted plant, which forges messages, stops, is late or is replaced."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager

import msgspec
import numpy as np
import pytest
import zenoh

from lbmpc.plants import get_plant
from node_runtime.bus.zenoh_bus import Bus, session_config
from node_runtime.config.sections import Config
from node_runtime.realtime import clock
from node_runtime.router import open_router
from protocol import codec, topics
from protocol import messages as m
from tests.helpers.live import HANG_S, BusListener, Process, health_of, live_config, matched, wait_for

PLANT = get_plant("moore_greitzer")
WAITING = health_of("controller", status="ready", note="no plant: waiting for its states")
SETTINGS = ("controller.horizon=20", "controller.keyframe_every=20", "network.hidden=[8, 8]")


class Script:
    """A plant played by the test, which sends states in step with the controller's answers."""

    def __init__(self, config: Config, run_id: str = "plant-a"):
        self.bus = Bus(config, "plant", run_id)
        self.bus.open()
        self.run_id = run_id
        self.seq = -1
        self.key = topics.PLANT_STATE.key(config.name)
        self.foreign = zenoh.open(session_config("client", config.bus.endpoint, config.bus.lease_ms))
        self.began = clock.now()

    def state(self, **changes: object) -> m.PlantState:
        good = m.PlantState(
            run_id=self.run_id,
            seq=self.seq + 1,
            t=clock.now(),
            x=PLANT.x0.tolist(),
            applied=None,
            source="hold",
            command_seq=-1,
        )
        return msgspec.structs.replace(good, **changes)

    def send(self, **changes: object) -> m.PlantState:
        state = self.state(**changes)
        self.seq += 1
        self.bus.publish(topics.PLANT_STATE, state)
        return state

    def forge(self, payload: bytes | m.Message) -> None:
        self.foreign.put(self.key, payload if isinstance(payload, bytes) else codec.encode(payload))

    def period(self, config: Config) -> None:
        """Wait until the next state is due."""
        due = self.began + np.ceil((clock.now() - self.began) / config.period + 0.01) * config.period
        clock.sleep_until(float(due))

    def close(self) -> None:
        self.foreign.close()
        self.bus.close()


@contextmanager
def beside_a_script(config: Config) -> Iterator[tuple[BusListener, Script, Process]]:
    """Run a live controller whose plant the test plays; it waits for the first state. End it within the block."""
    with open_router(config), Bus(config, "recorder", "recorder-a") as bus, closing(Script(config)) as script:
        ear = BusListener(bus)
        with Process("controller_node.node", config) as process:
            ear.until(WAITING)
            wait_for(lambda: matched(script.bus, topics.PLANT_STATE))
            yield ear, script, process


@pytest.mark.live
def test_only_valid_states_are_used_and_an_outage_is_bridged() -> None:
    config = live_config(*SETTINGS)
    with beside_a_script(config) as (ear, script, process):
        # The first sender is followed.
        good = [script.send().seq]
        ear.until(lambda message: isinstance(message, m.Tick))
        for _ in range(20):
            script.period(config)
            script.forge(script.state(run_id="plant-b"))
            good.append(script.send().seq)
            script.forge(b"junk")
            script.forge(script.state(x=[float("nan")] * 4))
            script.forge(script.state(x=[0.0]))
            script.forge(script.state(seq=0))
        wait_for(lambda: any(tick.seq >= 15 for tick in ear.of(topics.TICK)))
        # After a silence the queued messages arrive all at once and old.
        silent = clock.now()
        ear.until(lambda message: isinstance(message, m.Tick) and message.state_verdict == "missing")
        for k in range(3):
            script.send(t=silent - 5.0 + k * config.period)
        ear.until(lambda message: isinstance(message, m.Tick) and message.state_verdict == "stale")
        # The plan ends, the controller waits, and continues when the plant is back.
        ear.until(WAITING)
        ticks_before = ear.of(topics.TICK)[-1].seq
        again: list[int] = []
        while all(tick.seq <= ticks_before for tick in ear.of(topics.TICK) if tick.state_verdict == "fresh"):
            script.period(config)
            again.append(script.send().seq)
        process.signal(signal.SIGTERM)
        assert process.end() == 0
    ticks: list[m.Tick] = ear.of(topics.TICK)
    assert [tick.seq for tick in ticks] == list(range(len(ticks)))
    assert {tick.state.run_id for tick in ticks if tick.state} == {"plant-a"}
    assert {tick.state.seq for tick in ticks if tick.state_verdict == "fresh"} <= {*good, *again}
    by_seq = {tick.seq: tick for tick in ticks}
    for command in ear.of(topics.COMMAND):
        if by_seq[command.seq].state_verdict != "fresh":
            assert command.state_seq == -1
            assert command.mode != "solver"
    counters = ear.of(topics.HEALTH["controller"])[-1].counters
    for reason in ("malformed", "not finite", "wrong size", "out of order", "foreign"):
        assert counters[m.counter_name("bad plant/state", reason)] >= 15, reason
        assert process.said.count(f"bad plant/state: {reason}") == 1
    assert counters["states_missing"] >= 15


@pytest.mark.live
def test_constantly_late_states_count_as_punctual_after_a_while() -> None:
    """The plant's clock loses five seconds: there are no ticks without a state meanwhile, and control resumes."""
    config = live_config(*SETTINGS)
    with beside_a_script(config) as (ear, script, process):

        def played(behind: float, until: Callable[[], bool]) -> None:
            end = clock.now() + HANG_S
            while not until() and clock.now() < end:
                script.period(config)
                script.send(t=clock.now() - behind)

        def fresh() -> list[m.Tick]:
            return [tick for tick in ear.of(topics.TICK) if tick.state_verdict == "fresh"]

        played(0.0, lambda: len(fresh()) > 10)
        before = len(fresh())
        played(5.0, lambda: len(fresh()) > before + 10)
        process.signal(signal.SIGTERM)
        assert process.end() == 0
    notes = [health.note for health in ear.of(topics.HEALTH["controller"])]
    assert notes.count("no plant: its states come too late to act on") >= 1
    assert "now count as punctual" in process.said
    late = [tick for tick in ear.of(topics.TICK) if tick.state_verdict == "stale"]
    # There are as many as entries in the plan, and none after that.
    assert len(late) <= config.controller.horizon
    assert len(fresh()) > before + 10


@pytest.mark.live
def test_another_plant_is_followed_after_silence() -> None:
    config = live_config(*SETTINGS, "bus.follow_silence=0.3")
    with open_router(config), Bus(config, "recorder", "recorder-a") as bus:
        ear = BusListener(bus)

        def fresh_from(run_id: str) -> m.Tick:
            tick = ear.until(
                lambda message: (
                    isinstance(message, m.Tick)
                    and message.state_verdict == "fresh"
                    and message.state is not None
                    and message.state.run_id == run_id
                )
            )
            assert isinstance(tick, m.Tick)
            return tick

        with Process("controller_node.node", config) as process:
            run_ids = []
            for _ in range(2):
                with Process("plant_sim.node", config):
                    state = ear.until(lambda m_: isinstance(m_, m.PlantState) and m_.run_id not in run_ids)
                    run_ids.append(state.run_id)
                    fresh_from(state.run_id)
                    # A command that answers it releases it, although the controller has run before.
                    ear.until(lambda m_: isinstance(m_, m.PlantState) and m_.source == "command")
            process.signal(signal.SIGINT)
            assert process.end() == 0
    ticks = ear.of(topics.TICK)
    assert [tick.seq for tick in ticks] == list(range(len(ticks)))
