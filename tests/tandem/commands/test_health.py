"""`tandem health`: its text and exit code for every status of a process."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from contextlib import ExitStack

import pytest
import zenoh

from node_runtime.bus.zenoh_bus import Bus, session_config
from node_runtime.config.sections import Config
from node_runtime.health import HealthPublisher, HealthThread
from node_runtime.provenance import run_info
from node_runtime.realtime import clock
from node_runtime.router import open_router
from protocol import topics
from protocol.messages import ProcessStatus
from tandem.commands import health
from tests.helpers.interpreter import imported
from tests.helpers.live import HANG_S, BusListener, health_of, live_config

pytestmark = pytest.mark.live


@pytest.fixture(scope="module")
def config() -> Iterator[Config]:
    """The configuration of a bus with a router and no other process."""
    config = live_config()
    with open_router(config):
        yield config


@pytest.mark.parametrize(
    ("status", "code"), [("starting", 1), ("ready", 0), ("running", 0), ("stopping", 1), ("failed", 1)]
)
def test_the_exit_code_follows_the_status(
    config: Config, status: ProcessStatus, code: int, capsys: pytest.CaptureFixture[str]
) -> None:
    with (
        Bus(config, "recorder", "recorder-1") as other,
        Bus(config, "plant", "plant-1") as bus,
        HealthPublisher(bus, run_info(config, "plant", "plant-1")) as said,
    ):
        ear = BusListener(other)
        said.set(status, "held at x0")
        # After that no older message is still on its way.
        ear.until(health_of("plant", status=status, note="held at x0"))
        assert health.answer(config, "plant", HANG_S, as_json=False) == code
        assert capsys.readouterr().out == f"plant: {status}: held at x0\n"
        assert health.answer(config, "plant", HANG_S, as_json=True) == code
        shown = json.loads(capsys.readouterr().out)
    assert (shown["process"], shown["run_id"], shown["status"]) == ("plant", "plant-1", status)


def test_messages_of_another_process_do_not_count(config: Config, capsys: pytest.CaptureFixture[str]) -> None:
    with (
        Bus(config, "plant", "plant-1") as bus,
        HealthPublisher(bus, run_info(config, "plant", "plant-1")) as said,
    ):
        said.set("running")
        assert health.answer(config, "trainer", 1.0, as_json=False) == 1
    assert "trainer: no message for 1 s at tcp/127.0.0.1:" in capsys.readouterr().out


def test_garbage_is_not_health(config: Config) -> None:
    topic, done = topics.HEALTH["plant"], threading.Event()
    with (
        Bus(config, "plant", "plant-1") as bus,
        Bus(config, "recorder", "recorder-1") as other,
        zenoh.open(session_config("client", config.bus.endpoint, 1500)) as raw,
    ):
        ear = BusListener(other)

        def garble() -> None:
            while not done.wait(0.01):
                raw.put(topic.key(config.name), b"\xc1 not msgpack")

        garbler = threading.Thread(target=garble)
        garbler.start()
        with HealthPublisher(bus, run_info(config, "plant", "plant-1")) as said:
            said.set("running")
            ear.until(health_of("plant", status="running"))
            heard = health.ask(config, "plant", HANG_S)
        done.set()
        garbler.join()
    assert heard is not None
    assert heard.status == "running"


def test_without_a_router_it_gives_up_in_time(capsys: pytest.CaptureFixture[str]) -> None:
    began = clock.now()
    assert health.answer(live_config(), "router", 0.5, as_json=True) == 1
    assert clock.now() - began < HANG_S
    assert json.loads(capsys.readouterr().out)["status"] is None


def test_it_loads_nothing_heavy() -> None:
    code = (
        "from node_runtime.config.sections import Config; from tandem.commands import health;"
        "assert health.ask(Config(), 'plant', 0.05) is None"
    )
    assert not imported(code) & {"torch", "casadi", "scipy", "matplotlib", "mcap"}


def test_one_health_thread_lets_many_speak_until_they_leave(config: Config) -> None:
    with Bus(config, "recorder", "recorder-1") as other, HealthThread() as thread, ExitStack() as stack:
        ear = BusListener(other)
        before = threading.active_count()
        buses = [stack.enter_context(Bus(config, "plant", f"plant-{k}")) for k in range(3)]
        of_buses = threading.active_count() - before
        said = [
            stack.enter_context(HealthPublisher(bus, run_info(config, "plant", bus.run_id), thread=thread))
            for bus in buses
        ]
        assert threading.active_count() - before == of_buses
        said[1].set("running", "well")
        runs = {bus.run_id for bus in buses}

        def spoke(at_least: int, among: set[str]) -> bool:
            """Each process sends its run info, and its health more than once."""
            infos = {message.run_id for message in ear.of(topics.RUN_INFO["plant"])}
            healths = [(message.run_id, message.seq) for message in ear.of(topics.HEALTH["plant"])]
            return among <= infos and all((run, at_least) in healths for run in among)

        ear.until(lambda _message: spoke(2, runs))
        said[2].__exit__(None, None, None)
        gone = said[2]._seq
        ear.until(lambda _message: spoke(6, runs - {"plant-2"}))
        assert gone == said[2]._seq
        last = [message for message in ear.of(topics.HEALTH["plant"]) if message.run_id == "plant-2"][-1]
        assert last.status == "stopping"
        thread.add(said[2])
