"""The inbox: the sender to follow, the age of messages, and the rejection of invalid messages."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Iterator

import msgspec
import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from node_runtime.bus.inbox import AgeEstimate, Follower, Inbox
from node_runtime.bus.mailbox import Delivery
from node_runtime.bus.zenoh_bus import Bus, session_config
from node_runtime.realtime import clock
from node_runtime.rejected import RejectedMessages
from node_runtime.router import open_router
from protocol import codec, topics
from protocol import messages as m
from tests.helpers.live import HANG_S, live_config, wait_for


def state(seq: int, t: float = 0.0, run_id: str = "plant-a", x: list[float] | None = None) -> m.PlantState:
    return m.PlantState(
        run_id=run_id,
        seq=seq,
        t=t,
        x=[0.1, 0.2, 0.3, 0.4] if x is None else x,
        applied=None,
        source="hold",
        command_seq=-1,
    )


# -- the sender to follow ----------------------------------------------------------------------------------


def test_the_first_incarnation_is_followed_in_order() -> None:
    follower = Follower(silence=1.0)
    assert follower.accept("a", 5, 0.0) == "ok"
    assert follower.accept("a", 5, 0.1) == "out of order"
    assert follower.accept("a", 4, 0.2) == "out of order"
    assert follower.accept("b", 9, 0.3) == "foreign"
    assert follower.accept("a", 6, 0.4) == "ok"


def test_another_incarnation_takes_over_only_after_silence() -> None:
    follower = Follower(silence=1.0)
    assert follower.accept("a", 0, 0.0) == "ok"
    assert follower.accept("b", 0, 1.0) == "foreign"
    assert follower.accept("b", 1, 1.1) == "ok"
    assert follower.accept("a", 1, 1.2) == "foreign"
    assert follower.run_id == "b"


def test_refused_messages_do_not_keep_a_sender_in_control() -> None:
    follower = Follower(silence=1.0)
    follower.accept("a", 2**60, 0.0)
    # A forged number must not exclude the true sender permanently.
    assert [follower.accept("a", k, 0.3 * k) for k in range(1, 5)] == ["out of order"] * 3 + ["ok"]


@given(st.lists(st.tuples(st.sampled_from("abc"), st.integers(0, 20), st.floats(0.0, 0.4))))
def test_accepted_messages_rise_or_follow_a_silence(messages: list[tuple[str, int, float]]) -> None:
    follower, now, accepted = Follower(silence=1.0), 0.0, []
    for run_id, seq, wait in messages:
        now += wait
        if follower.accept(run_id, seq, now) == "ok":
            accepted.append((run_id, seq, now))
    for (run_a, seq_a, at_a), (run_b, seq_b, at_b) in itertools.pairwise(accepted):
        assert (run_a == run_b and seq_b > seq_a) or at_b - at_a > 1.0


# -- the age ---------------------------------------------------------------------------------------------


def test_age_is_the_excess_over_the_shortest_delay() -> None:
    ages, offset = AgeEstimate(), 1234.5
    for sent, delay in ((0.0, 0.004), (0.05, 0.001), (0.1, 0.003)):
        ages.observe(sent, sent + offset + delay)
    assert ages.age(0.1, 0.1 + offset + 0.003) == pytest.approx(0.002, abs=1e-4)


def test_a_burst_after_an_outage_is_old_except_its_end() -> None:
    ages = AgeEstimate()
    for k in range(100):
        ages.observe(0.05 * k, 0.05 * k + 0.001)
    burst_at = 8.0
    seen = []
    for k in range(100, 161):
        ages.observe(0.05 * k, burst_at)
        seen.append(ages.age(0.05 * k, burst_at))
    assert seen[0] == pytest.approx(3.0, abs=0.01)
    assert seen[-1] == pytest.approx(0.0, abs=0.01)
    assert sum(age > 0.04 for age in seen) == 60


def test_clock_drift_does_not_age_messages() -> None:
    ages = AgeEstimate()
    oldest = 0.0
    for k in range(20_000):
        sent = 0.05 * k
        arrived = sent * (1 + 5e-5) + 0.001
        ages.observe(sent, arrived)
        oldest = max(oldest, ages.age(sent, arrived))
    assert oldest < 1e-4


# -- counters --------------------------------------------------------------------------------------------


def test_bad_messages_are_counted_and_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    bad = RejectedMessages()
    with caplog.at_level(logging.WARNING):
        for k in range(50):
            bad.count("plant/state", "not finite", f"field x.{k}")
        bad.count("plant/state", "malformed", "truncated")
    assert bad.counters() == {"bad_plant_state_not_finite": 50, "bad_plant_state_malformed": 1}
    assert [record.getMessage().count("x.0") for record in caplog.records] == [1, 0]


def test_the_kinds_of_bad_messages_are_bounded() -> None:
    bad = RejectedMessages()
    for k in range(10_000):
        bad.count(f"topic {k}", "malformed", "")
    assert len(bad.counters()) <= 201
    assert bad.total == 10_000


# -- over a real bus --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def buses() -> Iterator[tuple[Bus, zenoh.Session]]:
    """Return a bus, and a foreign session that can send any bytes."""
    config = live_config("bus.follow_silence=30.0")
    with open_router(config), Bus(config, "controller", "controller-x") as bus:
        foreign = zenoh.open(session_config("client", config.bus.endpoint, config.bus.lease_ms))
        yield bus, foreign
        foreign.close()


class Sender:
    def __init__(self, buses: tuple[Bus, zenoh.Session]):
        self.bus, session = buses
        self.inbox: Inbox[m.PlantState] = Inbox(
            self.bus, topics.PLANT_STATE, states=4, inputs=1, sent=lambda message: message.t
        )
        # A burst would overflow the control lane, which drops messages instead of waiting.
        block = zenoh.CongestionControl.BLOCK
        key = topics.PLANT_STATE.key(self.bus.config.name)
        self.publisher = session.declare_publisher(key, congestion_control=block)
        wait_for(lambda: self.publisher.matching_status.matching)
        self.before = self.bus.counters()

    def send(self, *payloads: bytes | m.Message) -> None:
        for payload in payloads:
            self.publisher.put(payload if isinstance(payload, bytes) else codec.encode(payload))

    def counted(self) -> dict[str, int]:
        """Return the counters since the start of the test."""
        now = self.bus.counters()
        return {key: now[key] - self.before.get(key, 0) for key in now if now[key] != self.before.get(key, 0)}


@pytest.mark.live
def test_invalid_messages_are_rejected_and_counted(buses: tuple[Bus, zenoh.Session]) -> None:
    sender = Sender(buses)
    good = state(0)
    unknown_field = msgspec.msgpack.encode(msgspec.to_builtins(good) | {"extra": 1})
    text_seq = msgspec.msgpack.encode(msgspec.to_builtins(good) | {"seq": "zero"})
    sender.send(
        good,
        b"",
        b"\xff\x00garbage",
        codec.encode(good)[:-3],
        unknown_field,
        text_seq,
        b"\x91" * 5000,
        bytes(topics.PLANT_STATE.max_bytes + 1),
        state(1, x=[float("nan"), 0.0, 0.0, 0.0]),
        state(2, t=float("inf")),
        state(3, x=[0.0, 0.0]),
        state(0),
        state(7, run_id="plant-b"),
        state(4, t=1e9),
        state(5, t=0.01),
    )
    heard = []
    wait_for(lambda: heard.extend(sender.inbox.take_all()) or (bool(heard) and heard[-1].message.seq == 5))
    assert [received.message.seq for received in heard] == [0, 5]
    assert sender.counted() == {
        "bad_plant_state_malformed": 6,
        "bad_plant_state_oversized": 1,
        "bad_plant_state_not_finite": 2,
        "bad_plant_state_wrong_size": 1,
        "bad_plant_state_out_of_order": 1,
        "bad_plant_state_foreign": 1,
        "bad_plant_state_implausible_time": 1,
    }


@pytest.mark.live
def test_garbage_behind_a_good_message_does_not_hide_it(buses: tuple[Bus, zenoh.Session]) -> None:
    sender = Sender(buses)
    sender.send(state(0), b"junk", state(1), b"junk", b"junk")
    wait_for(lambda: sender.counted().get("bad_plant_state_malformed", 0) == 0 and _waiting(sender) == 5)
    received = sender.inbox.take()
    assert received is not None
    assert received.message.seq == 1
    assert sender.inbox.take() is None


@pytest.mark.live
def test_a_jumped_clock_is_accepted_after_a_silence(buses: tuple[Bus, zenoh.Session]) -> None:
    """A machine that was suspended must not be excluded permanently."""
    sender = Sender(buses)
    sender.inbox.follower = Follower(silence=0.2)
    seqs, heard = itertools.count(), []

    def hears(ahead: float) -> bool:
        sender.send(state(next(seqs), t=clock.now() + ahead))
        heard.extend(sender.inbox.take_all())
        return bool(heard) and heard[-1].message.t > clock.now() + ahead - 50.0

    wait_for(lambda: hears(0.0))
    wait_for(lambda: hears(100.0))
    assert sender.counted()["bad_plant_state_implausible_time"] >= 1
    assert sender.inbox.age(heard[-1], heard[-1].arrived) < 0.05


class Endless:
    """A mailbox with an endless stream of garbage."""

    def drain(self) -> list[Delivery]:
        return [self.get(0.0)]

    def get(self, timeout_s: float) -> Delivery:
        return Delivery("plant/state", b"junk", clock.now_ns())


@pytest.mark.live
def test_endless_garbage_does_not_block_a_reader(
    buses: tuple[Bus, zenoh.Session], monkeypatch: pytest.MonkeyPatch
) -> None:
    sender = Sender(buses)
    monkeypatch.setattr(sender.inbox, "_mailbox", Endless())
    began = clock.now()
    assert sender.inbox.wait(0.05) is None
    assert 0.05 <= clock.now() - began < HANG_S


def _waiting(sender: Sender) -> int:
    return len(sender.inbox._mailbox)


@pytest.mark.live
def test_waiting_skips_invalid_messages(buses: tuple[Bus, zenoh.Session]) -> None:
    sender = Sender(buses)
    sender.send(b"junk", b"junk", state(0))
    received = sender.inbox.wait(HANG_S)
    assert received is not None
    assert received.message.seq == 0
    before = clock.now()
    assert sender.inbox.wait(0.05) is None
    assert clock.now() - before < HANG_S


@pytest.mark.live
def test_old_data_in_a_burst_is_recognised(buses: tuple[Bus, zenoh.Session]) -> None:
    sender = Sender(buses)
    now = clock.now()
    # The first message is on time; after three seconds of silence all others arrive at once.
    sender.send(state(0, t=now))
    first = sender.inbox.wait(HANG_S)
    assert first is not None
    assert sender.inbox.age(first, first.arrived) == 0.0
    old, sent = [state(1 + k, t=now - 3.0 + 0.05 * k) for k in range(60)], clock.now()
    sender.send(*old, state(61, t=sent))
    heard = []
    wait_for(lambda: heard.extend(sender.inbox.take_all()) or len(heard) == 61)
    ages = [sender.inbox.age(received, received.arrived) for received in heard]
    assert all(age > 0.05 for age in ages[:-1])
    assert ages[0] > 2.9
    # Each is only as old as its own delay; messages before it have no effect.
    assert ages[-1] <= heard[-1].arrived - sent
