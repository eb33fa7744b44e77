"""A recorder without processor time loses no message. Lost messages are counted and reported."""

from __future__ import annotations

import signal
from pathlib import Path

import msgspec
import pytest

from lbmpc.plants import get_plant
from node_runtime.bus.session import PATIENT_LEASE_MS, lease_ms
from node_runtime.bus.zenoh_bus import Bus
from node_runtime.config.loading import override
from node_runtime.realtime import clock
from node_runtime.router import open_router
from protocol import codec, topics
from protocol import messages as m
from run_log.reading.gaps import holes, lost_ticks
from run_log.reading.reader import read_run
from run_log.reporting.summary import summarise
from run_log.run import gather
from run_log.writing.writer import LogWriter
from tests.helpers.live import HANG_S, Process, live_config, matched, wait_for
from tests.run_log.samples import RUN, synthetic

LEASE_S = 0.3


def timing(seq: int) -> m.TickTiming:
    return m.TickTiming(
        run_id="controller-a", seq=seq, solve_ms=0.1, tick_ms=0.2, lateness_ms=0.0, state_age_ms=0.0
    )


@pytest.mark.live
@pytest.mark.parametrize("rate", [20, 1000])
def test_a_recorder_without_processor_time_for_longer_than_the_lease_loses_nothing(
    tmp_path: Path, rate: int
) -> None:
    """Real-time loops on both cores once caused this: the router cut the recorder's link, and seconds were lost."""
    path = tmp_path / "run.mcap"
    config = live_config(f"bus.lease_ms={LEASE_S * 1e3:.0f}", f'log.path="{path}"', f"rate={rate}")
    with open_router(config), Process("run_log.writing.recorder", config) as recorder:
        # Only the recorder's lease matters here: the link of the other side holds however late this process is.
        with Bus(override(config, ["bus.lease_ms=60000"]), "controller", "controller-a") as bus:
            wait_for(lambda: matched(bus, topics.TIMING) and matched(bus, topics.BATCH["controller"]))
            bus.publish(topics.TIMING, timing(0))
            recorder.signal(signal.SIGSTOP)
            seq, end = 0, clock.now() + 3 * LEASE_S
            while clock.now() < end:
                seq += 1
                bus.publish(topics.TIMING, timing(seq))
                clock.sleep_until(clock.now() + 1e-3)
            recorder.signal(signal.SIGCONT)
            assert bus.flush(HANG_S)
        recorder.signal(signal.SIGTERM)
        assert recorder.end() == 0
    assert [one.seq for one in read_run(path).timings] == list(range(seq + 1))


def test_only_processes_that_obey_each_other_have_a_short_lease() -> None:
    config = override(live_config(), ["bus.lease_ms=300"])
    assert [lease_ms(config, name) for name in ("plant", "controller")] == [300, 300]
    assert [lease_ms(config, name) for name in ("recorder", "monitor", "trainer")] == [PATIENT_LEASE_MS] * 3
    assert lease_ms(override(config, ["bus.lease_ms=60000"]), "recorder") == 60000


def test_lost_messages_are_counted_by_the_recorder_and_in_the_figures(tmp_path: Path) -> None:
    config, messages = synthetic(steps=60)
    each = {topics.TICK.name, topics.COMMAND.name, topics.RESULT.name}
    kept = [one for one in messages if not (one[0].name in each and 20 <= one[1].seq < 27)]
    # One more result, of another tick.
    kept = [one for one in kept if not (one[0] is topics.RESULT and one[1].seq == 40)]
    with LogWriter(tmp_path / "run.mcap", config, get_plant(config.plant.model)) as writer:
        for topic, message, log_time in kept:
            writer.write(topic.name, codec.encode(message), log_time)
        assert writer.lost == {"controller/tick": 7, "controller/result": 8}
        assert writer.counters["lost_ticks"] == 8
    run = read_run(tmp_path / "run.mcap")
    assert lost_ticks(run) == [(RUN, 20, 7), (RUN, 40, 1)]
    assert summarise(run).lost_ticks == 8
    assert summarise(gather(config, messages)).lost_ticks == 0


def test_repeated_and_strangers_messages_are_no_gap(tmp_path: Path) -> None:
    config, messages = synthetic(steps=60)
    with LogWriter(tmp_path / "run.mcap", config, get_plant(config.plant.model)) as writer:
        for topic, message, log_time in messages:
            writer.write(topic.name, codec.encode(message), log_time)
            if topic is topics.RESULT and message.seq == 30:
                old = next(one for of, one, _ in messages if of is topics.RESULT and one.seq == 10)
                writer.write(topic.name, codec.encode(old), log_time + 1)
                strange = msgspec.structs.replace(message, run_id="stranger", seq=500)
                for seq in (500, 900):
                    again = msgspec.structs.replace(strange, seq=seq)
                    writer.write(topic.name, codec.encode(again), log_time + 2)
        assert writer.lost == {}


def test_gaps_in_a_log() -> None:
    assert holes([], 1, 0) == []
    assert holes([], 3, 5) == [(3, 3)]
    assert holes([4, 5, 6, 8], 1, 10) == [(1, 3), (7, 1), (9, 2)]
    assert holes([0, 1, 2**63 - 1], 0, 2**63 - 1) == [(2, 2**63 - 3)]
    assert holes([-5, 1, 99], 1, 2) == [(2, 1)]
