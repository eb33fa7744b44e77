"""The recorder as a separate process: it logs every message, and neither a kill nor a full disk damages the log."""

from __future__ import annotations

import resource
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import zenoh

from node_runtime.bus.zenoh_bus import Bus, session_config
from node_runtime.config.loading import override
from node_runtime.config.sections import Config
from node_runtime.realtime import clock
from node_runtime.router import open_router
from protocol import codec, topics
from protocol import messages as m
from run_log.errors import LogError
from run_log.reading.reader import read_run
from run_log.reading.recover import recover
from run_log.replaying.replay import replay
from run_log.reporting.summary import summarise
from run_log.writing.parts import existing_parts
from tests.helpers.live import BusListener, Process, free_endpoint, health_of, live_config, matched, wait_for

pytestmark = pytest.mark.live


@pytest.fixture(scope="module")
def base() -> Iterator[Config]:
    config = live_config("controller.horizon=20", "controller.keyframe_every=20", "controller.oracle=linear")
    with open_router(config):
        yield config


@pytest.fixture
def config(base: Config, tmp_path: Path) -> Config:
    # A separate plant name, so that messages of other tests are not on this bus.
    name = f"jet{abs(hash(tmp_path)) % 10**8}"
    return override(base, [f'log.path="{tmp_path / "run.mcap"}"', f"name={name}"])


@pytest.fixture
def plant(config: Config) -> Iterator[Bus]:
    with Bus(config, "plant", "plant-a") as bus:
        yield bus


@pytest.fixture
def ear(plant: Bus) -> BusListener:
    return BusListener(plant)


def state(seq: int, x: float = 1.0) -> m.PlantState:
    return m.PlantState(
        run_id="plant-a", seq=seq, t=0.01 * seq, x=[x] * 4, applied=None, source="hold", command_seq=-1
    )


def timing(seq: int) -> m.TickTiming:
    """Return a message of the bulk lane, which never drops one, however late its sending thread is."""
    return m.TickTiming(
        run_id="controller-a", seq=seq, solve_ms=0.1, tick_ms=0.2, lateness_ms=0.0, state_age_ms=0.0
    )


def recorder(config: Config) -> Process:
    return Process("run_log.writing.recorder", config)


def noted(text: str) -> Callable[[m.Message], bool]:
    running = health_of("recorder", status="running")
    return lambda message: running(message) and isinstance(message, m.Health) and text in message.note


def recorded(plant: Bus, ear: BusListener, process: Process, config: Config) -> None:
    """Wait until the recorder receives messages of the plant."""
    ear.until(noted("writing"))
    wait_for(lambda: matched(plant, topics.PLANT_STATE))


def test_every_message_is_in_the_log(config: Config, plant: Bus, ear: BusListener) -> None:
    timings = [timing(i) for i in range(300)]
    garbage = [b"", b"\x00" * 100, codec.encode(state(1, float("nan")))]
    with recorder(config) as process:
        recorded(plant, ear, process, config)
        before = time.time_ns()
        stranger = zenoh.open(session_config("client", config.bus.endpoint, config.bus.lease_ms))
        for payload in garbage:
            stranger.put(f"tandem/{config.name}/controller/tick", payload)
        stranger.put(f"tandem/{config.name}/no/such/topic", b"hello")
        plant.publish(topics.PLANT_STATE, state(0))
        for message in timings:
            plant.publish(topics.TIMING, message)
        ear.until(lambda x: noted("writing")(x) and x.counters["messages"] >= 305)
        process.signal(signal.SIGINT)
        # Other processes still send messages when all are told to stop.
        last_words = [timing(300 + i) for i in range(20)]
        for message in last_words:
            clock.sleep_until(clock.now() + 0.02)
            plant.publish(topics.TIMING, message)
        assert process.end() == 0
        stranger.close()
    run = read_run(config.log.path)
    assert not run.truncated
    assert run.config == config
    assert [e.payload for e in run.entries(topics.PLANT_STATE)] == [codec.encode(state(0))]
    payloads, said = [e.payload for e in run.entries(topics.TIMING)], [*timings, *last_words]
    assert payloads == [codec.encode(one) for one in said[: len(payloads)]]
    # The recorder ends after a time without messages, and this process may have been without a core for as long.
    assert len(payloads) >= 305
    assert run.bad == {"controller/tick: malformed": 2, "controller/tick: not finite": 1} or run.bad == {
        "controller/tick: malformed": 3
    }
    assert run.strangers == {"no/such/topic": 1}
    assert {info.process for info in run.run_infos} == {"recorder"}
    times = [entry.log_time for entry in run.entries(topics.TIMING)]
    assert times == sorted(times)
    # The wall clock and the monotonic one are read one after the other.
    assert before - 10**9 < times[0] < times[-1] < time.time_ns() + 10**9


def readable(path: str) -> int:
    """Return the number of timings in a log that is being written."""
    try:
        return len(read_run(path).timings)
    except LogError:
        return 0


def test_a_long_run_is_logged_in_parts(config: Config, plant: Bus, ear: BusListener) -> None:
    with recorder(override(config, ["log.split_minutes=0.01"])) as process:
        recorded(plant, ear, process, config)
        plant.publish(topics.TIMING, timing(0))
        said = ear.until(noted("run.part2.mcap"))
        assert isinstance(said, m.Health)
        plant.publish(topics.TIMING, timing(1))
        ear.until(lambda x: noted("part2")(x) and x.counters["messages"] > said.counters["messages"])
        process.signal(signal.SIGINT)
        assert process.end() == 0
    first, second = (read_run(part) for part in existing_parts(Path(config.log.path)))
    # No keyframe arrived, so both files were written to the end, and each contains its recorder's run info.
    assert [timing.seq for timing in first.timings] == [0, 1]
    assert [timing.seq for timing in second.timings] == [1]
    assert [info.process for info in first.run_infos + second.run_infos] == ["recorder", "recorder"]
    assert (first.continued, second.part) == ("run.part2.mcap", 2)


def test_a_killed_recorder_leaves_all_messages_before_its_last_flush(
    config: Config, plant: Bus, ear: BusListener
) -> None:
    """`make faults` measures that only the last half second is missing."""
    stop = threading.Event()

    def talk() -> None:
        for seq in range(100_000):
            plant.publish(topics.TIMING, timing(seq))
            if stop.wait(0.005):
                return

    talker = threading.Thread(target=talk, daemon=True)
    with recorder(config) as process:
        recorded(plant, ear, process, config)
        talker.start()
        ear.until(lambda x: noted("writing")(x) and x.counters["messages"] >= 100)
        # The log is readable while it is written, so it is readable after a kill.
        wait_for(lambda: readable(config.log.path) >= 90)
        flushed = readable(config.log.path)
        process.signal(signal.SIGKILL)
        process.end()
        stop.set()
        talker.join()
    run = read_run(config.log.path)
    assert run.truncated
    count = len(run.timings)
    assert count >= flushed
    assert [one.seq for one in run.timings] == list(range(count))
    out = Path(config.log.path).with_suffix(".recovered.mcap")
    assert recover(config.log.path, out).messages == sum(map(len, run.streams.values()))
    assert [one.seq for one in read_run(out).timings] == list(range(count))


def talk_while_full(
    config: Config, plant: Bus, ear: BusListener, fill: Callable[[int], None], free: Callable[[int], None]
):
    """The disk fills up, stays full, and has room again: no message is lost, and Health reports each change."""
    noise = [m.Keyframe(run_id="plant-a", seq=i, arrays={"a": array(i)}) for i in range(20)]
    with recorder(config) as process:
        recorded(plant, ear, process, config)
        fill(process._popen.pid)
        for message in noise:
            plant.publish(topics.KEYFRAME, message)
        trouble = ear.until(noted("NOT LOGGED"))
        assert isinstance(trouble, m.Health)
        assert "cannot be written" in trouble.note
        assert trouble.counters["write_errors"] > 0
        plant.publish(topics.PLANT_STATE, state(0))
        free(process._popen.pid)
        ear.until(noted("writing"))
        process.signal(signal.SIGTERM)
        assert process.end() == 0
    assert "cannot be written" in process.said
    run = read_run(config.log.path)
    assert not run.truncated
    assert run.keyframes == noise
    assert run.plant_states == [state(0)]


def array(seed: int) -> m.Array:
    """Random bytes, which do not compress."""
    import numpy as np

    return m.Array.of(np.random.default_rng(seed).normal(size=2000))


def test_a_full_quota_is_waited_for(config: Config, plant: Bus, ear: BusListener) -> None:
    full, none = (100_000, resource.RLIM_INFINITY), (resource.RLIM_INFINITY, resource.RLIM_INFINITY)
    talk_while_full(
        config,
        plant,
        ear,
        fill=lambda pid: resource.prlimit(pid, resource.RLIMIT_FSIZE, full),
        free=lambda pid: resource.prlimit(pid, resource.RLIMIT_FSIZE, none),
    )


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=100k", "tmpfs", str(disk)]
    if subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("mounting a small disk needs privileges")
    yield disk
    subprocess.run(["umount", "-l", str(disk)], check=True)


def test_a_full_disk_is_waited_for(config: Config, plant: Bus, ear: BusListener, small_disk: Path) -> None:
    grow = ["mount", "-o", "remount,size=10m", str(small_disk)]
    talk_while_full(
        override(config, [f'log.path="{small_disk / "run.mcap"}"']),
        plant,
        ear,
        fill=lambda pid: None,
        free=lambda pid: subprocess.run(grow, check=True) and None,
    )


def test_a_place_that_is_never_writable(config: Config, plant: Bus, ear: BusListener, tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    with recorder(override(config, [f'log.path="{tmp_path / "file" / "run.mcap"}"'])) as process:
        ear.until(noted("NOT LOGGED"))
        plant.publish(topics.PLANT_STATE, state(0))
        process.signal(signal.SIGTERM)
        assert process.end() == 4
    assert "cannot be created" in process.said


def test_an_existing_log_is_left_alone(config: Config) -> None:
    Path(config.log.path).write_bytes(b"mine")
    with recorder(config) as process:
        assert process.end() == 2
    assert "exists already" in process.said
    assert Path(config.log.path).read_bytes() == b"mine"


def test_stopped_before_there_was_a_router(config: Config) -> None:
    alone = override(config, [f'bus.endpoint="{free_endpoint()}"'])
    with recorder(alone) as process:
        next(line for line in process.lines() if "no router" in line)
        process.signal(signal.SIGINT)
        assert process.end() == 0
    assert not read_run(config.log.path).truncated


def test_a_live_loop_replays_byte_for_byte(config: Config, ear: BusListener) -> None:
    """The log of three real processes reproduces every command."""
    with recorder(config) as log:
        ear.until(noted("writing"))
        with (
            Process("plant_sim.node", config) as plant,
            Process("controller_node.node", config) as controller,
        ):
            ear.until(lambda x: isinstance(x, m.Tick) and x.seq >= 50)
            for process in (controller, plant, log):
                process.signal(signal.SIGINT)
                assert process.end() == 0
    run = read_run(config.log.path)
    assert not run.bad
    found = replay(run)
    assert found.equal, found
    assert found.ticks >= 51
    assert found.ticks == len(run.commands) == len(run.ticks)
    assert replay(run, 45).first_tick == 40
    assert summarise(run).ticks == found.ticks
