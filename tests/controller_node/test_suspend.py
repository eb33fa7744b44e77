"""All processes are stopped for some time and continue; the ticks recorded before and after can be replayed."""

from __future__ import annotations

import signal
from contextlib import ExitStack
from pathlib import Path

import pytest

from node_runtime.bus.zenoh_bus import Bus
from protocol import messages as m
from run_log.reading.reader import read_run
from run_log.replaying.replay import replay
from tests.helpers.live import BusListener, Process, health_of, live_config

LEASE_S = 0.3
SETTINGS = (
    f"bus.lease_ms={LEASE_S * 1e3:.0f}",
    "controller.horizon=20",
    "controller.solver.compile=never",
    # Without a keyframe of its own, a gap would make the rest of the run unusable for a replay.
    "controller.keyframe_every=100000",
    "network.hidden=[8, 8]",
)
STOPPED = ("plant_sim.node", "controller_node.node", "run_log.writing.recorder")


@pytest.mark.live
def test_after_a_standstill_every_recorded_tick_replays(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    config = live_config(*SETTINGS, f"log.path={path}")
    with ExitStack() as stack:
        router = stack.enter_context(Process("node_runtime.router", config))
        nodes = [stack.enter_context(Process(module, config)) for module in STOPPED]
        bus = stack.enter_context(Bus(config, "monitor", "monitor-a"))
        ear = BusListener(bus)

        def ticked(after: int) -> int:
            tick = ear.until(lambda message: isinstance(message, m.Tick) and message.seq > after + 20)
            assert isinstance(tick, m.Tick)
            return tick.seq

        ear.until(health_of("recorder", status="running"))
        before = ticked(-1)
        # The router stops first and continues last, so the ticks in between and the links are lost.
        router.signal(signal.SIGSTOP)
        while ear.listen(4 * LEASE_S) is not None:
            pass
        for node in nodes:
            node.signal(signal.SIGSTOP)
        for process in (*nodes, router):
            process.signal(signal.SIGCONT)
        ticked(ticked(before))
        # The recorder continues last.
        for node in (nodes[1], nodes[0], nodes[2]):
            node.signal(signal.SIGINT)
            assert node.end() == 0
    run = read_run(path)
    recorded = [tick.seq for tick in run.ticks]
    found = replay(run)
    assert found.equal
    assert found.ticks == len(recorded), (recorded, [frame.seq for frame in run.keyframes], found.notes)


@pytest.mark.live
def test_everything_a_late_recorder_receives_can_be_replayed(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    config = live_config(*SETTINGS, f"log.path={path}")
    with ExitStack() as stack:
        stack.enter_context(Process("node_runtime.router", config))
        nodes = [stack.enter_context(Process(module, config)) for module in STOPPED[:2]]
        with Bus(config, "monitor", "monitor-a") as bus:
            # There is no other listener after this one has left.
            BusListener(bus).until(lambda message: isinstance(message, m.Tick) and message.seq > 5)
        recorder = stack.enter_context(Process(STOPPED[2], config))
        next(line for line in recorder.lines() if "writing" in line)
        with Bus(config, "monitor", "monitor-b") as bus:
            ear = BusListener(bus)
            tick = ear.until(lambda message: isinstance(message, m.Tick))
            ear.until(lambda message: isinstance(message, m.Tick) and message.seq > tick.seq + 30)
        for process in (*nodes[::-1], recorder):
            process.signal(signal.SIGINT)
            assert process.end() == 0
    found = replay(read_run(path))
    assert (found.equal, found.lost_ticks) == (True, 0), found.notes
    assert found.first_tick > 5
