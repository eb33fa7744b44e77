"""Batches of a fast loop's messages, which log and views receive as single messages."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import pytest

from node_runtime.bus.batches import UnbatchingMailbox
from node_runtime.bus.bulk_queue import BulkQueue
from node_runtime.bus.mailbox import Delivery
from node_runtime.bus.zenoh_bus import Bus
from node_runtime.config.loading import override
from node_runtime.config.sections import Config
from node_runtime.rejected import RejectedMessages
from node_runtime.router import open_router
from protocol import codec, topics
from protocol import messages as m
from protocol.topics import Topic
from tests.helpers.live import HANG_S, live_config, matched, wait_for

BATCH = topics.BATCH["controller"]
KEY = BATCH.key("jet1")


def timing(seq: int) -> m.TickTiming:
    return m.TickTiming(
        run_id="controller-a", seq=seq, solve_ms=0.1, tick_ms=0.2, lateness_ms=0.0, state_age_ms=0.0
    )


def state(seq: int) -> m.PlantState:
    return m.PlantState(
        run_id="plant-a", seq=seq, t=1e-3 * seq, x=[1.0, 2.0], applied=None, source="hold", command_seq=-1
    )


def hear(heard: list[Delivery], new: list[Delivery]) -> list[Delivery]:
    heard.extend(new)
    return heard


class Sent:
    """A queue whose messages are sent to this object at once."""

    def __init__(self) -> None:
        self.batches: list[bytes] = []
        self.queue = BulkQueue("controller-a", BATCH, lambda send: send(), self._send)

    def _send(self, topic: Topic, payload: bytes) -> None:
        assert topic is BATCH
        self.batches.append(payload)


def batched(count: int) -> tuple[bytes, list[bytes]]:
    sent = Sent()
    payloads = [codec.encode(timing(seq)) for seq in range(count)]
    for k, payload in enumerate(payloads):
        sent.queue.put_batched(topics.TIMING, payload, 100_000 * k)
    assert sent.batches == []
    assert sent.queue.flush(0.0)
    assert sent.queue.flush(0.0)
    (batch,) = sent.batches
    return batch, payloads


def test_a_batch_is_unpacked_byte_for_byte_in_order_with_original_times() -> None:
    batch, payloads = batched(30)
    mailbox = UnbatchingMailbox("everything", 10, RejectedMessages())
    mailbox.put(Delivery("tandem/jet1/plant/state", b"alone", 5))
    mailbox.put(Delivery(KEY, batch, 10**9))
    first = mailbox.get()
    assert first == Delivery("tandem/jet1/plant/state", b"alone", 5)
    second = mailbox.get()
    assert second is not None
    rest = [second, *mailbox.drain()]
    assert [one.payload for one in rest] == payloads
    assert {one.key for one in rest} == {topics.TIMING.key("jet1")}
    steps = {b.received_ns - a.received_ns for a, b in itertools.pairwise(rest)}
    assert steps == {100_000}
    assert rest[-1].received_ns <= 10**9


def test_messages_wait_at_most_twenty_milliseconds() -> None:
    sent, due = Sent(), []
    for k in range(21):
        sent.queue.put_batched(topics.TIMING, b"x", 1_000_000 * k)
        due.append(len(sent.batches))
    assert due == [0] * 20 + [1]


@pytest.mark.parametrize("payload", [b"", b"\xc1", codec.encode(timing(0))])
def test_an_unreadable_batch_is_counted_and_delivered(payload: bytes) -> None:
    bad = RejectedMessages()
    mailbox = UnbatchingMailbox("everything", 10, bad)
    delivery = Delivery(KEY, payload, 1)
    mailbox.put(delivery)
    assert mailbox.drain() == [delivery]
    assert bad.counters() == {"bad_controller_batch_malformed": 1}


@pytest.mark.parametrize(("rate", "together"), [(20.0, False), (100.0, False), (101.0, True), (1000.0, True)])
def test_only_a_fast_loop_sends_batches(rate: float, together: bool) -> None:
    for topic in (topics.TICK, topics.RESULT, topics.TIMING, topics.PLANT_STATE, topics.COMMAND):
        assert topic.batched_at(rate) is together
    for topic in (topics.KEYFRAME, topics.OUTPUT_WEIGHTS, topics.SAMPLES, topics.HIDDEN_WEIGHTS):
        assert not topic.batched_at(rate)


@pytest.fixture(scope="module")
def config() -> Iterator[Config]:
    config = override(live_config(), ["rate=1000"])
    with open_router(config):
        yield config


@pytest.mark.live
def test_control_messages_are_delivered_directly_and_logged_once(config: Config) -> None:
    with (
        Bus(config, "plant", "plant-a") as plant,
        Bus(config, "controller", "controller-a") as controller,
        Bus(config, "recorder", "recorder-a") as recorder,
    ):
        states, everything = controller.queue(topics.PLANT_STATE), recorder.everything()
        wait_for(lambda: matched(plant, topics.PLANT_STATE) and matched(plant, topics.BATCH["plant"]))
        payloads = [codec.encode(state(seq)) for seq in range(50)]
        # Send one by one, as a loop does, because the control lane drops messages when the link is full.
        for seq in range(50):
            plant.publish(topics.PLANT_STATE, state(seq))
            wait_for(lambda: len(states) == seq + 1)  # noqa: B023 - called within this iteration
        # They arrive long before the batch is due, under the same key as at any rate.
        assert [one.payload for one in states.drain()] == payloads
        assert plant.flush(HANG_S)
        heard: list[Delivery] = []
        wait_for(lambda: len(hear(heard, everything.drain())) >= 50)
        assert [one.payload for one in heard] == payloads
        assert {one.key for one in heard} == {topics.PLANT_STATE.key(config.name)}


@pytest.mark.live
def test_a_plant_that_publishes_under_the_plain_key_is_received_at_any_rate(config: Config) -> None:
    slow = override(config, ["rate=20"])
    with Bus(slow, "plant", "plant-a") as foreign, Bus(config, "controller", "controller-a") as controller:
        states = controller.queue(topics.PLANT_STATE)
        wait_for(lambda: matched(foreign, topics.PLANT_STATE))
        foreign.publish(topics.PLANT_STATE, state(7))
        wait_for(lambda: len(states) == 1)


@pytest.mark.live
def test_the_order_of_publication_is_kept(config: Config) -> None:
    with Bus(config, "controller", "controller-a") as bus, Bus(config, "recorder", "recorder-a") as recorder:
        everything = recorder.everything()
        wait_for(lambda: matched(bus, BATCH) and matched(bus, topics.KEYFRAME))
        for seq in range(3):
            bus.publish(topics.TIMING, timing(seq))
        bus.publish(topics.KEYFRAME, m.Keyframe(run_id="controller-a", seq=2, arrays={}))
        bus.publish(topics.TIMING, timing(3))
        assert bus.flush(HANG_S)
        heard: list[Delivery] = []
        wait_for(lambda: len(hear(heard, everything.drain())) >= 5)
        names = [topics.TIMING] * 3 + [topics.KEYFRAME, topics.TIMING]
        assert [one.key for one in heard] == [topic.key(config.name) for topic in names]
