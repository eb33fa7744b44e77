"""Large messages in fragments: joined in any order, in bounded memory, with invalid fragments rejected."""

from __future__ import annotations

import zlib
from collections.abc import Iterator

import msgspec
import numpy as np
import pytest
import zenoh

from node_runtime.bus.fragments import (
    FRAGMENT_BYTES,
    HEADER_BYTES,
    INCOMPLETE,
    MARK,
    Fragment,
    Fragmenter,
    Reassembler,
)
from node_runtime.bus.zenoh_bus import Bus, session_config
from node_runtime.config.sections import Config
from node_runtime.rejected import RejectedMessages
from node_runtime.router import open_router
from protocol import codec, topics
from protocol import messages as m
from tests.helpers.live import HANG_S, live_config, matched, wait_for

MESSAGE = np.random.default_rng(0).bytes(5 * FRAGMENT_BYTES + 17)
LIMIT = 64 * FRAGMENT_BYTES


def fragments(message: bytes = MESSAGE, writer: str = "trainer-a", number: int = 0) -> list[bytes]:
    """Return the fragments of the process's message with that number, counted from 0."""
    sending = Fragmenter(writer)
    return [list(sending.split(message)) for _ in range(number + 1)][-1]


def altered(payload: bytes, **changes: object) -> bytes:
    fragment = msgspec.msgpack.decode(payload[1:], type=Fragment)
    return MARK + msgspec.msgpack.encode(msgspec.structs.replace(fragment, **changes))


class Receiver:
    def __init__(self, limit: int = LIMIT) -> None:
        self.bad = RejectedMessages()
        self.reassembler = Reassembler(limit, self.bad)

    def take(self, *payloads: bytes, name: str = "x") -> list[bytes]:
        found = (self.reassembler.whole(name, payload, LIMIT) for payload in payloads)
        return [whole for whole in found if whole is not None]


def test_small_messages_are_sent_whole() -> None:
    assert fragments(MESSAGE[:FRAGMENT_BYTES]) == [MESSAGE[:FRAGMENT_BYTES]]
    assert Receiver().take(b"", b"\x80", MESSAGE[:FRAGMENT_BYTES]) == [b"", b"\x80", MESSAGE[:FRAGMENT_BYTES]]


def test_no_message_starts_like_a_fragment() -> None:
    health = m.Health(run_id="a", seq=0, process="plant", status="ready", counters={}, note="")
    assert codec.encode(health)[:1] != MARK


def test_fragments_are_joined_in_any_order_and_twice() -> None:
    parts = fragments()
    assert len(parts) == 6
    assert max(map(len, parts)) <= FRAGMENT_BYTES + HEADER_BYTES
    receiver = Receiver()
    order = np.random.default_rng(1).permutation(6)
    assert receiver.take(*(parts[k] for k in order)) == [MESSAGE]
    assert receiver.reassembler.held == 0
    twice = [part for part in parts for _ in range(2)][:-1]
    assert receiver.take(*twice) == [MESSAGE]
    assert receiver.bad.counters() == {}


def test_a_lost_fragment_loses_only_its_message() -> None:
    receiver = Receiver()
    assert receiver.take(*fragments()[1:], *fragments(number=1)) == [MESSAGE]
    assert receiver.bad.counters() == {"bad_x_pieces_lost": 1}
    assert receiver.take(*fragments()[:1]) == []
    receiver.reassembler.end()
    assert receiver.reassembler.held == 0
    assert receiver.bad.counters() == {"bad_x_pieces_lost": 2}


def test_writers_and_topics_do_not_mix() -> None:
    receiver = Receiver()
    mixed = zip(fragments(), fragments(MESSAGE[::-1], "trainer-b"), strict=True)
    assert receiver.take(*(part for pair in mixed for part in pair)) == [MESSAGE, MESSAGE[::-1]]
    assert receiver.take(*fragments()[:3]) == []
    assert receiver.take(*fragments()[3:], name="y") == []


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (MARK, "malformed piece"),
        (MARK + b"\x00" * 40, "malformed piece"),
        (fragments()[0][:-1], "malformed piece"),
        (MARK + bytes(FRAGMENT_BYTES + HEADER_BYTES), "oversized piece"),
        (altered(fragments()[0], size=LIMIT + 1), "oversized"),
        (altered(fragments()[0], size=FRAGMENT_BYTES), "malformed piece"),
        (altered(fragments()[0], index=6), "malformed piece"),
        (altered(fragments()[0], index=5), "malformed piece"),
        (altered(fragments()[0], data=b""), "malformed piece"),
        (altered(fragments()[0], writer="w" * 200), "malformed piece"),
    ],
)
def test_an_invalid_fragment_is_counted_without_other_effect(payload: bytes, reason: str) -> None:
    receiver, parts = Receiver(), fragments()
    assert receiver.take(*parts[:3], payload, *parts[3:]) == [MESSAGE]
    assert receiver.bad.counters() == {m.counter_name("bad x", reason): 1}


def test_a_corrupted_message_is_not_used() -> None:
    receiver, parts = Receiver(), fragments()
    assert receiver.take(altered(parts[0], data=bytes(FRAGMENT_BYTES)), *parts[1:]) == []
    assert receiver.bad.counters() == {"bad_x_pieces_do_not_make_the_message": 1}
    assert receiver.take(parts[0], altered(parts[1], crc32=zlib.crc32(b"")), *parts[1:]) == [MESSAGE]


def test_many_foreign_writers_cannot_fill_the_memory() -> None:
    """With one byte each, few bytes are held."""
    receiver, small = Receiver(), altered(fragments()[0], size=FRAGMENT_BYTES + 1, index=1, data=b"x")
    for k in range(INCOMPLETE + 500):
        receiver.take(altered(small, writer=f"foreign-{k}"))
    assert receiver.reassembler.held == INCOMPLETE
    assert receiver.bad.counters() == {"bad_x_pieces_lost": 500}
    assert receiver.take(*fragments()) == [MESSAGE]


def test_a_foreign_writer_cannot_fill_the_memory() -> None:
    receiver = Receiver(limit=8 * FRAGMENT_BYTES)
    for k in range(300):
        receiver.take(*fragments(writer=f"foreign-{k}")[:2])
        assert receiver.reassembler.held <= 8 * FRAGMENT_BYTES
    assert receiver.take(*fragments()) == [MESSAGE]


# -- over a real router --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def config() -> Iterator[Config]:
    config = live_config()
    with open_router(config):
        yield config


def keyframe(size: int) -> m.Keyframe:
    data = np.random.default_rng(2).bytes(size)
    return m.Keyframe(run_id="controller-a", seq=0, arrays={"a": m.Array("|u1", [size], data)})


@pytest.mark.live
def test_only_fragments_are_sent_and_every_reader_gets_the_message(config: Config) -> None:
    sent = keyframe(3_000_000)
    travelled: list[int] = []
    with (
        Bus(config, "controller", "controller-a") as controller,
        Bus(config, "recorder", "recorder-a") as recorder,
        zenoh.open(session_config("client", config.bus.endpoint, 1500)) as foreign,
    ):
        all_of_it, one = recorder.everything(), recorder.queue(topics.KEYFRAME)
        foreign.declare_subscriber("tandem/**", lambda sample: travelled.append(len(sample.payload)))
        wait_for(lambda: matched(controller, topics.KEYFRAME))
        controller.publish(topics.KEYFRAME, sent)
        wait_for(lambda: len(one) == 1 and len(all_of_it) == 1)
        for mailbox in (all_of_it, one):
            delivery = mailbox.get()
            assert delivery is not None
            assert delivery.payload == codec.encode(sent)
        wait_for(lambda: sum(travelled) > 3_000_000)
        assert max(travelled) <= FRAGMENT_BYTES + HEADER_BYTES
        assert controller.counters()["sent_bulk"] == len(travelled)


@pytest.mark.live
def test_answers_are_sent_in_fragments(config: Config) -> None:
    answers = [codec.encode(keyframe(size)) for size in (700_000, 10, 2_000_000)]
    with (
        Bus(config, "controller", "controller-a") as controller,
        Bus(config, "trainer", "trainer-a") as trainer,
    ):
        controller.serve("controller/large", lambda _parameters: answers)
        found: list[list[bytes]] = []
        wait_for(lambda: bool(found.append(trainer.ask("controller/large", {}, HANG_S)) or found[-1]))
        assert found[-1] == answers
        assert "bad_controller_large_pieces_lost" not in trainer.counters()
