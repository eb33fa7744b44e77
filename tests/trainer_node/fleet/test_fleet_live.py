"""The trainer of a fleet on a real bus: plants are found by their messages, and each gets its own weights."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator
from contextlib import ExitStack

import msgspec
import pytest

from node_runtime.config.sections import Config
from tests.trainer_node.partner import Controller
from trainer_node.main import main

pytestmark = pytest.mark.live


@pytest.fixture
def fleet(config: Config) -> Iterator[Config]:
    """Run a trainer of all jets in a thread."""
    stop = threading.Event()
    thread = threading.Thread(target=main, args=[config, stop, "jet*"])
    thread.start()
    yield config
    stop.set()
    thread.join(60.0)
    assert not thread.is_alive()


def named(config: Config, name: str) -> Config:
    return msgspec.structs.replace(config, name=name)


def test_two_plants_get_weights_and_an_unmatched_one_gets_none(
    fleet: Config, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    with (
        Controller(named(fleet, "jet1"), "one") as one,
        Controller(named(fleet, "jet2"), "two", seed=1) as two,
        Controller(named(fleet, "pump"), "three") as pump,
    ):
        for controller in (one, two):
            for other in (one, two, pump):
                other.tick(20)
            controller.until(lambda h: h.counters.get("adopted", 0) >= 1, tick=True)
        assert {weights.for_run for weights in one.adopted} == {"one"}
        assert {weights.for_run for weights in two.adopted} == {"two"}
        pump.tick()
        assert not pump.adopted
    assert "jet2 added" in caplog.text
    assert "pump" not in caplog.text


def test_the_number_of_threads_does_not_grow_with_the_plants(fleet: Config) -> None:
    """Between the second plant and the sixth, the trainer starts only threads that wait for answers."""
    with ExitStack() as stack:

        def comes(name: str) -> None:
            plant = stack.enter_context(Controller(named(fleet, name), name))
            plant.until(lambda h: h.counters.get("joined", 0) >= 1, tick=True)

        comes("jet1")
        comes("jet2")
        trainers = {thread.name for thread in threading.enumerate()}
        for k in range(3, 7):
            comes(f"jet{k}")
        more = {thread.name for thread in threading.enumerate()} - trainers
        assert not [name for name in more if "health" in name or "jet" in name]
        assert [thread.name for thread in threading.enumerate()].count("health") == 1
