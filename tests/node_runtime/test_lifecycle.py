"""Signals, real-time priority with and without the privilege, garbage collection, health."""

from __future__ import annotations

import gc
import itertools
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from node_runtime.bus.zenoh_bus import Bus
from node_runtime.config.loading import override
from node_runtime.config.sections import Config
from node_runtime.config.strict import ConfigError
from node_runtime.health import HealthPublisher
from node_runtime.lifecycle import REPEATED_SIGNAL_S, new_run_id, run_process, stopped_by_signals
from node_runtime.provenance import run_info
from node_runtime.realtime import clock
from node_runtime.realtime.scheduling import (
    GarbageCollection,
    awake,
    core_for,
    on_core,
    punctual,
    quick_handover,
)
from node_runtime.router import open_router
from protocol import messages as m
from protocol import topics
from tests.helpers.live import HANG_S, BusListener, health_of, live_config, matched, wait_for

STUBBORN = """
import threading
from pathlib import Path
from node_runtime.lifecycle import stopped_by_signals
with stopped_by_signals() as stop:
    print("running", flush=True)
    stop.wait()
    print("told", flush=True)
    threading.Event().wait()
"""
UNPRIVILEGED = """
import logging, os, resource, sys
from node_runtime.realtime.scheduling import punctual
logging.basicConfig(format="%(message)s")
resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))
if os.geteuid() == 0:
    os.setuid(65534)
with punctual(50) as note:
    print(note)
"""


def test_run_ids_are_fresh_and_fit_a_message() -> None:
    ids = {new_run_id("controller") for _ in range(100)}
    assert len(ids) == 100
    assert all(run_id.startswith("controller-") and len(run_id) <= 64 for run_id in ids)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_first_signal_requests_a_stop_and_a_later_one_ends_the_process(number: signal.Signals) -> None:
    with subprocess.Popen([sys.executable, "-c", STUBBORN], stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "running\n"
            first = clock.now()
            process.send_signal(number)
            process.send_signal(number)
            assert process.stdout.readline() == "told\n"
            # An immediate repetition counts as the same signal, so the process must still run.
            assert process.poll() is None or clock.now() - first > REPEATED_SIGNAL_S
            while process.poll() is None:
                assert clock.now() - first < HANG_S
                clock.sleep_until(clock.now() + 0.1)
                process.send_signal(number)
            assert clock.now() - first > REPEATED_SIGNAL_S
            assert process.returncode == -number
        finally:
            process.kill()


def test_signal_handlers_are_restored() -> None:
    before = signal.getsignal(signal.SIGINT)
    with stopped_by_signals() as stop:
        os.kill(os.getpid(), signal.SIGINT)
        assert stop.wait(HANG_S)
    assert signal.getsignal(signal.SIGINT) is before


def test_outside_the_main_thread_signals_are_not_handled() -> None:
    given, seen = threading.Event(), []

    def work() -> None:
        with stopped_by_signals(given) as stop:
            seen.append(stop)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [given]


def test_a_process_without_a_router_can_be_stopped() -> None:
    def body(stopping: threading.Event) -> int:
        with Bus(live_config(), "plant", "plant-a", stopping):
            return 7

    stop = threading.Event()
    threading.Timer(0.2, stop.set).start()
    assert run_process(body, stop) == 0


def test_an_unusable_configuration_gives_an_exit_code(caplog: pytest.LogCaptureFixture) -> None:
    def body(_stopping: threading.Event) -> int:
        raise ConfigError("rate = -1.0 is not a number above 0")

    assert run_process(body) == 2
    assert "rate = -1.0 is not a number above 0" in caplog.text


def test_without_the_privilege_there_are_one_warning_and_a_note() -> None:
    done = subprocess.run([sys.executable, "-c", UNPRIVILEGED], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert "no privilege for SCHED_FIFO priority 50" in done.stdout
    assert done.stderr.count("no privilege") == 1
    assert "CAP_SYS_NICE" in done.stderr


def test_the_cores_are_kept_awake_while_the_loop_runs(tmp_path: Path) -> None:
    device = tmp_path / "cpu_dma_latency"
    device.touch()
    with awake(device=str(device)) as note:
        assert note == ""
        assert device.read_bytes() == bytes(4)
        opened = [os.path.realpath(f"/proc/self/fd/{fd}") for fd in os.listdir("/proc/self/fd")]
        assert str(device) in opened
    opened = [os.path.realpath(f"/proc/self/fd/{fd}") for fd in os.listdir("/proc/self/fd")]
    assert str(device) not in opened


def test_without_permission_the_loop_runs_with_a_note(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with awake(device=str(tmp_path / "missing")) as note:
        assert "cores may sleep" in note
    assert len(caplog.records) == 1
    assert "realtime.awake = never" in caplog.text
    with awake(False, device=str(tmp_path / "missing")) as note:
        assert note == ""
    assert len(caplog.records) == 1


@pytest.mark.parametrize(
    ("assignments", "awake"),
    [
        (["rate=20"], False),
        (["rate=1000"], True),
        (["rate=1000", "realtime.priority=0"], False),
        (["rate=1000", "realtime.awake=never"], False),
        (["rate=20", "realtime.awake=always"], True),
        (["rate=20", "realtime.awake=always", "realtime.priority=0"], True),
    ],
)
def test_cores_are_kept_awake_at_high_rates(assignments: list[str], awake: bool) -> None:
    assert override(Config(), assignments).awake is awake


@pytest.mark.parametrize(
    ("assignments", "allowed", "controller", "plant"),
    [
        (["rate=20"], {0, 1}, None, None),
        (["rate=1000"], {0, 1}, 1, 0),
        (["rate=1000"], {2, 5, 7}, 7, 5),
        (["rate=1000"], {3}, None, None),
        (["rate=1000", "realtime.priority=0"], {0, 1}, None, None),
        (["rate=1000", "realtime.cores=any"], {0, 1}, None, None),
        (["rate=20", "realtime.cores=[0,1]"], {0, 1}, 0, 1),
        (["rate=20", "realtime.cores=[1,1]"], {0, 1}, 1, 1),
    ],
)
def test_loops_have_cores_of_their_own_at_high_rates(
    assignments: list[str], allowed: set[int], controller: int | None, plant: int | None
) -> None:
    config = override(Config(), assignments)
    assert core_for(config, "controller", allowed) == controller
    assert core_for(config, "plant", allowed) == plant


@pytest.mark.parametrize("cores", ["[0,9]", "[0]", "[0,1,0]"])
def test_a_missing_core_is_refused(cores: str) -> None:
    config = override(Config(), [f"realtime.cores={cores}"])
    with pytest.raises(ConfigError, match=r"write \[controller's core, plant's core\].* may use 0, 1"):
        core_for(config, "plant", {0, 1})


def test_only_the_loop_stays_on_its_core() -> None:
    before = os.sched_getaffinity(0)
    core = max(before)
    with on_core(core):
        assert os.sched_getaffinity(0) == {core}
    assert os.sched_getaffinity(0) == before
    with on_core(None):
        assert os.sched_getaffinity(0) == before


def test_a_punctual_loop_restores_all_settings() -> None:
    before = os.sched_getscheduler(0), sys.getswitchinterval(), gc.get_freeze_count()
    with punctual(1) as note:
        assert (os.sched_getscheduler(0) == os.SCHED_FIFO) == (note == "")
        GarbageCollection().begin()
        assert not gc.isenabled()
    assert gc.isenabled()
    assert (os.sched_getscheduler(0), sys.getswitchinterval(), gc.get_freeze_count()) == before


def test_a_child_does_not_inherit_its_supervisors_priority() -> None:
    program = (
        "import os, sys; os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1));"
        "from tandem import child; sys.argv = ['child', str(os.getppid()), 'config', 'show', '--json'];"
        "child.main(); print(os.sched_getscheduler(0), file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    if "PermissionError" in done.stderr:
        pytest.skip("no privilege for SCHED_FIFO")
    assert done.stderr.split()[-1] == str(os.SCHED_OTHER)


def test_threads_give_way_quickly_during_the_loop() -> None:
    before = sys.getswitchinterval()
    with quick_handover():
        assert sys.getswitchinterval() <= 1e-4
    assert sys.getswitchinterval() == before


def test_priority_0_keeps_the_scheduling() -> None:
    with punctual(0) as note:
        assert note == ""
        assert os.sched_getscheduler(0) == os.SCHED_OTHER


def test_garbage_is_collected_between_steps_only() -> None:
    with punctual(0):
        garbage = GarbageCollection(every=3)
        garbage.begin()
        collections = [sum(generation["collections"] for generation in gc.get_stats())]
        for _ in range(6):
            garbage.idle()
            collections.append(sum(generation["collections"] for generation in gc.get_stats()))
    assert [b - a for a, b in itertools.pairwise(collections)] == [0, 0, 1, 0, 0, 1]


@pytest.mark.live
def test_health_is_published_regularly_and_at_every_change() -> None:
    config = live_config()
    with (
        open_router(config),
        Bus(config, "recorder", "r") as listener,
        Bus(config, "plant", "plant-a") as bus,
    ):
        ear = BusListener(listener)
        wait_for(lambda: matched(bus, topics.HEALTH["plant"]) and matched(bus, topics.RUN_INFO["plant"]))
        info = run_info(config, "plant", "plant-a", {"z": "1"})
        with HealthPublisher(bus, info, lambda: {"samples": 7}, "standing note") as health:
            ear.until(lambda message: isinstance(message, m.RunInfo))
            first = ear.until(health_of("plant", status="starting", note="standing note"))
            health.set("running")
            health.set("running")
            ear.until(health_of("plant", status="running"))
            health.set("running", "changed")
            changed = ear.until(health_of("plant", status="running", note="standing note; changed"))
            for _ in range(2):
                ear.until(health_of("plant", status="running"))
        ear.until(health_of("plant", status="stopping"))
        assert isinstance(first, m.Health)
        assert isinstance(changed, m.Health)
        assert first.counters["samples"] == 7
        heard = ear.of(topics.HEALTH["plant"])
        assert [one.seq for one in heard] == list(range(len(heard)))
        with pytest.raises(RuntimeError), HealthPublisher(bus, info):
            raise RuntimeError("the model is broken")
        ear.until(health_of("plant", status="failed", note="RuntimeError: the model is broken"))
