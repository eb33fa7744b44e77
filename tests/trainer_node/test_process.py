"""The trainer as a process: killed and replaced, told to stop, without a router, with training disabled."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading

import msgspec
import pytest

from node_runtime.config.loading import to_json
from node_runtime.config.sections import BusConfig, Config
from tests.helpers.live import PROGRAM
from tests.trainer_node.partner import PATIENCE, TRAINING, Controller, holds
from trainer_node.main import main

pytestmark = pytest.mark.live


def process(config: Config) -> subprocess.Popen[bytes]:
    program = PROGRAM.format(module="trainer_node.main")
    return subprocess.Popen([sys.executable, "-c", program, to_json(config)])


def test_a_killed_process_is_replaced_and_its_successor_stops_on_request(config: Config) -> None:
    with Controller(config, "controller-1") as controller:
        first = process(config)
        try:
            health = controller.until(lambda h: h.counters["adopted"] >= 1, tick=True)
        finally:
            first.kill()
            first.wait(PATIENCE)
        controller.tick(40)
        second = process(config)
        try:
            controller.until(lambda h: h.counters["adopted"] >= 1, tick=True, ignored=health.run_id)
            last = controller.until(holds(controller.seq + 1), ignored=health.run_id)
            assert last.counters["buffer"] == controller.seq + 1
            second.send_signal(signal.SIGTERM)
            assert second.wait(PATIENCE) == 0
        finally:
            second.kill()
            second.wait(PATIENCE)


def test_it_can_be_stopped_without_a_router() -> None:
    config = Config(trainer=TRAINING, bus=BusConfig(endpoint="tcp/127.0.0.1:9"))
    stop = threading.Event()
    codes: list[int] = []
    thread = threading.Thread(target=lambda: codes.append(main(config, stop)))
    thread.start()
    stop.set()
    thread.join(PATIENCE)
    assert codes == [0]


def test_with_training_disabled_hidden_layers_are_not_trained(config: Config) -> None:
    config = msgspec.structs.replace(config, trainer=msgspec.structs.replace(TRAINING, enabled=False))
    stop = threading.Event()
    thread = threading.Thread(target=main, args=[config, stop])
    with Controller(config, "controller-1") as controller:
        thread.start()
        controller.until(lambda h: "trainer.enabled" in h.note)
        stop.set()
        thread.join(PATIENCE)
    assert not controller.adopted
