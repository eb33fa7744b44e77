"""The bus over a real router: newest values, bounded queues, no blocking, and restarts of the router."""

from __future__ import annotations

import signal
import socket
import threading
from collections.abc import Iterator
from pathlib import Path

import msgpack
import pytest
import zenoh

from node_runtime import router
from node_runtime.bus.mailbox import Delivery, Mailbox
from node_runtime.bus.zenoh_bus import Bus, OpenInterrupted, session_config
from node_runtime.config.loading import override
from node_runtime.config.sections import Config
from node_runtime.config.strict import ConfigError
from node_runtime.realtime import clock
from node_runtime.router import open_router
from protocol import codec, topics
from protocol import messages as m
from tandem import certificate_authority
from tests.helpers.live import HANG_S, Process, connected, free_endpoint, live_config, matched, wait_for

pytestmark = pytest.mark.live
BLOCKED_S = 5.0


def state(seq: int) -> m.PlantState:
    return m.PlantState(
        run_id="plant-a", seq=seq, t=0.05 * seq, x=[1.0, 2.0], applied=None, source="hold", command_seq=-1
    )


def keyframe(seq: int, size: int) -> m.Keyframe:
    array = m.Array("|u1", [size], bytes(size))
    return m.Keyframe(run_id="controller-a", seq=seq, arrays={"a": array})


@pytest.fixture(scope="module")
def config() -> Iterator[Config]:
    config = live_config()
    with open_router(config):
        yield config


@pytest.fixture
def plant(config: Config) -> Iterator[Bus]:
    with Bus(config, "plant", "plant-a") as bus:
        yield bus


@pytest.fixture
def controller(config: Config) -> Iterator[Bus]:
    with Bus(config, "controller", "controller-a") as bus:
        yield bus


def seq_of(delivery: Delivery | None) -> int:
    assert delivery is not None
    return codec.decode(topics.PLANT_STATE, delivery.payload).seq


# -- receiving -------------------------------------------------------------------------------------------


def test_a_queue_of_one_gives_the_newest_message_once(plant: Bus, controller: Bus) -> None:
    latest = controller.queue(topics.PLANT_STATE, capacity=1)
    wait_for(lambda: matched(plant, topics.PLANT_STATE))
    assert latest.get() is None
    for seq in range(10):
        plant.publish(topics.PLANT_STATE, state(seq))
        # Send one by one, because the control lane drops messages when the link is full.
        wait_for(lambda: len(latest) + latest.overflow == seq + 1)  # noqa: B023 - called within this iteration
    assert seq_of(latest.get()) == 9
    assert latest.get() is None
    assert latest.overflow == 9


def test_waiting_ends_with_a_message_or_the_timeout(plant: Bus, controller: Bus) -> None:
    latest = controller.queue(topics.PLANT_STATE, capacity=1)
    wait_for(lambda: matched(plant, topics.PLANT_STATE))
    assert latest.get(0.02) is None
    threading.Timer(0.05, plant.publish, (topics.PLANT_STATE, state(3))).start()
    before = clock.now()
    assert seq_of(latest.get(2 * HANG_S)) == 3
    assert clock.now() - before < HANG_S


def test_a_queue_keeps_order_and_its_bound(plant: Bus, controller: Bus) -> None:
    mailbox = controller.queue(topics.PLANT_STATE, capacity=5)
    wait_for(lambda: matched(plant, topics.PLANT_STATE))
    for seq in range(20):
        plant.publish(topics.PLANT_STATE, state(seq))
        wait_for(lambda: len(mailbox) + mailbox.overflow == seq + 1)  # noqa: B023 - called within this iteration
    deliveries = [mailbox.get(0.0) for _ in range(6)]
    assert [seq_of(d) for d in deliveries if d] == [15, 16, 17, 18, 19]
    assert deliveries[5] is None
    assert controller.counters()["overflow_plant_state"] == 15


def test_a_mailbox_is_bounded_in_bytes() -> None:
    mailbox = Mailbox("test", capacity=1000, max_bytes=1000)
    for k in range(50):
        mailbox.put(Delivery(str(k), bytes(100), 0))
    assert [delivery.key for delivery in mailbox.drain()] == [str(k) for k in range(40, 50)]
    assert mailbox.overflow == 40


def test_everything_delivers_the_exact_bytes_of_both_lanes(plant: Bus, controller: Bus) -> None:
    mailbox = controller.everything()
    health = m.Health(run_id="plant-a", seq=0, process="plant", status="ready", counters={"n": 1}, note="")
    wait_for(lambda: matched(plant, topics.PLANT_STATE) and matched(plant, topics.HEALTH["plant"]))
    plant.publish(topics.PLANT_STATE, state(1))
    plant.publish(topics.HEALTH["plant"], health)
    controller.publish(topics.KEYFRAME, keyframe(0, 100_000))
    wait_for(lambda: len(mailbox) == 3)
    heard = {delivery.key.removeprefix("tandem/jet1/"): delivery.payload for delivery in mailbox.drain()}
    assert heard["plant/state"] == codec.encode(state(1))
    assert heard["plant/health"] == codec.encode(health)
    assert heard["controller/keyframe"] == codec.encode(keyframe(0, 100_000))
    assert msgpack.unpackb(heard["plant/state"])["x"] == [1.0, 2.0]


def test_a_slow_reader_blocks_no_other(plant: Bus, controller: Bus) -> None:
    unread = controller.queue(topics.HEALTH["plant"], capacity=3)
    latest = controller.queue(topics.PLANT_STATE, capacity=1)
    health = m.Health(
        run_id="plant-a", seq=0, process="plant", status="ready", counters={}, note="x" * 20_000
    )
    wait_for(lambda: matched(plant, topics.PLANT_STATE) and matched(plant, topics.HEALTH["plant"]))
    for seq in range(300):
        plant.publish(topics.HEALTH["plant"], health)
        if seq % 50 == 0:
            plant.publish(topics.PLANT_STATE, state(seq))
            assert seq_of(latest.get(HANG_S)) == seq
    wait_for(lambda: len(unread) + unread.overflow == 300)
    assert unread.overflow == 297


def test_oversized_messages_are_neither_sent_nor_accepted(
    config: Config, plant: Bus, controller: Bus
) -> None:
    mailbox = controller.everything()
    wait_for(lambda: matched(plant, topics.PLANT_STATE))
    foreign = zenoh.open(session_config("client", config.bus.endpoint, config.bus.lease_ms))
    key = topics.PLANT_STATE.key(config.name)
    publisher = foreign.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK)
    wait_for(lambda: publisher.matching_status.matching)
    publisher.put(bytes(topics.PLANT_STATE.max_bytes + 1))
    wait_for(lambda: controller.counters().get("bad_plant_state_oversized", 0) == 1)
    foreign.close()
    note = "x" * topics.HEALTH["plant"].max_bytes
    large = m.Health(run_id="plant-a", seq=0, process="plant", status="ready", counters={}, note=note)
    plant.publish(topics.HEALTH["plant"], large)
    assert plant.counters()["not_sent_oversized_plant_health"] == 1
    plant.publish(topics.PLANT_STATE, state(0))
    wait_for(lambda: len(mailbox) > 0)
    assert [delivery.key for delivery in mailbox.drain()] == [key]


# -- sending ---------------------------------------------------------------------------------------------


def test_pending_messages_are_sent_before_closing(config: Config, controller: Bus) -> None:
    mailbox = controller.queue(topics.HEALTH["plant"])
    with Bus(config, "plant", "plant-b") as bus:
        wait_for(lambda: matched(bus, topics.HEALTH["plant"]))
        for seq in range(200):
            note = "y" * 30_000
            health = m.Health(
                run_id="plant-b", seq=seq, process="plant", status="stopping", counters={}, note=note
            )
            bus.publish(topics.HEALTH["plant"], health)
    wait_for(lambda: len(mailbox) == 200)


def test_a_blocked_link_does_not_block_the_loop() -> None:
    config = live_config("bus.lease_ms=60000")
    with (
        Process("node_runtime.router", config) as frozen,
        Bus(config, "controller", "controller-a") as bus,
        Bus(config, "plant", "plant-a") as reader,
    ):
        reader.everything()
        wait_for(lambda: matched(bus, topics.KEYFRAME) and matched(bus, topics.COMMAND))
        frozen.signal(signal.SIGSTOP)
        command = m.Command(
            run_id="controller-a",
            seq=0,
            state_run_id="",
            state_seq=-1,
            period=0.05,
            mode="solver",
            u=[1.0],
            plan=[[1.0]] * 20_000,
        )
        longest = 0.0
        for seq in range(60):
            before = clock.now()
            bus.publish(topics.COMMAND, command)
            bus.publish(topics.KEYFRAME, keyframe(seq, 8_000_000))
            longest = max(longest, clock.now() - before)
        # A full link delays a message by up to 5 s, and would delay 60 messages by that much each.
        assert longest < BLOCKED_S / 2
        assert bus.counters()["bulk_overflow"] > 20
        before = clock.now()
        reader.close(drain_s=0.2)
        bus.close(drain_s=0.2)
        assert clock.now() - before < HANG_S


# -- queries ---------------------------------------------------------------------------------------------


def test_a_query_is_answered_in_several_parts(plant: Bus, controller: Bus) -> None:
    asked: list[dict[str, str]] = []

    def handler(parameters: dict[str, str]) -> list[bytes]:
        asked.append(parameters)
        return [b"one", b"two", bytes(1_000_000)]

    controller.serve(topics.OUTBOX_QUERY, handler)
    wait_for(lambda: bool(plant.ask(topics.OUTBOX_QUERY, {"since": "7", "run": ""}, HANG_S)))
    answer = plant.ask(topics.OUTBOX_QUERY, {"since": "7", "run": "controller-a"}, HANG_S)
    assert answer == [b"one", b"two", bytes(1_000_000)]
    assert asked[-1] == {"since": "7", "run": "controller-a"}


def test_a_query_without_an_answer_is_not_an_error(plant: Bus) -> None:
    assert plant.ask(topics.OUTBOX_QUERY, {}, 0.2) == []


def test_a_wrong_query_is_counted_on_both_sides(plant: Bus, controller: Bus) -> None:
    def handler(parameters: dict[str, str]) -> list[bytes]:
        if parameters.get("since") == "seven":
            raise ValueError("since = 'seven' is not a whole number")
        return [b"fine"]

    controller.serve(topics.OUTBOX_QUERY, handler)
    wait_for(lambda: plant.ask(topics.OUTBOX_QUERY, {"since": "1"}, HANG_S) == [b"fine"])
    assert plant.ask(topics.OUTBOX_QUERY, {"since": "seven"}, HANG_S) == []
    assert controller.counters()["bad_controller_outbox_bad_query"] == 1
    assert plant.counters()["bad_controller_outbox_answered_with_an_error"] == 1
    assert plant.ask(topics.OUTBOX_QUERY, {"since": "1"}, HANG_S) == [b"fine"]


def test_an_oversized_query_is_dropped_unread(plant: Bus, controller: Bus) -> None:
    """A router's size limits apply to payloads; the parameters of a query may have any size."""
    asked: list[dict[str, str]] = []

    def handler(parameters: dict[str, str]) -> list[bytes]:
        asked.append(parameters)
        return [b"fine"]

    controller.serve(topics.OUTBOX_QUERY, handler)
    wait_for(lambda: plant.ask(topics.OUTBOX_QUERY, {"since": "1"}, HANG_S) == [b"fine"])
    asked.clear()
    assert plant.ask(topics.OUTBOX_QUERY, {"since": "1" * 100_000}, HANG_S) == []
    assert controller.counters()["bad_controller_outbox_oversized_question"] == 1
    assert plant.ask(topics.OUTBOX_QUERY, {"since": "2"}, HANG_S) == [b"fine"]
    assert asked == [{"since": "2"}]


def test_a_slow_answer_is_not_waited_for_and_blocks_no_other(plant: Bus, controller: Bus) -> None:
    release = threading.Event()
    controller.serve("controller/slow", lambda _: [b"late"] if release.wait(HANG_S) else [])
    latest = controller.queue(topics.PLANT_STATE, capacity=1)
    wait_for(lambda: matched(plant, topics.PLANT_STATE))
    assert plant.ask("controller/slow", {}, 0.3) == []
    for seq in range(50):
        plant.publish(topics.PLANT_STATE, state(seq))
        assert seq_of(latest.get(HANG_S)) == seq
    release.set()


# -- the router ------------------------------------------------------------------------------------------


def test_a_router_restart_is_survived() -> None:
    config = live_config()
    with (
        open_router(config) as first,
        Bus(config, "plant", "plant-a") as plant,
        Bus(config, "controller", "controller-a") as controller,
    ):
        latest = controller.queue(topics.PLANT_STATE, capacity=1)
        controller.serve(topics.OUTBOX_QUERY, lambda _: [b"answer"])
        wait_for(lambda: matched(plant, topics.PLANT_STATE))
        first.close()
        wait_for(lambda: not connected(plant) and not connected(controller))
        plant.publish(topics.PLANT_STATE, state(0))
        with open_router(config):
            wait_for(
                lambda: connected(plant) and connected(controller) and matched(plant, topics.PLANT_STATE)
            )
            plant.publish(topics.PLANT_STATE, state(1))
            assert seq_of(latest.get(HANG_S)) == 1
            wait_for(lambda: plant.ask(topics.OUTBOX_QUERY, {}, 1.0) == [b"answer"])


def test_opening_waits_for_the_router() -> None:
    config = live_config()
    bus = Bus(config, "plant", "plant-a")
    opening = threading.Thread(target=bus.open)
    opening.start()
    opening.join(0.3)
    assert opening.is_alive()
    with open_router(config):
        opening.join(HANG_S)
        assert not opening.is_alive()
        assert connected(bus)
        bus.close()


def test_opening_can_be_stopped() -> None:
    stop = threading.Event()
    threading.Timer(0.2, stop.set).start()
    before = clock.now()
    with pytest.raises(OpenInterrupted, match="router"), Bus(live_config(), "plant", "plant-a", stop):
        pass
    assert clock.now() - before < HANG_S


@pytest.mark.parametrize("endpoint", ["nonsense", "tcp/127.0.0.1", "carrier/127.0.0.1:1", "tcp/::1:1"])
def test_an_invalid_endpoint_gives_a_readable_error(endpoint: str) -> None:
    config = override(Config(), [f'bus.endpoint="{endpoint}"'])
    with pytest.raises(ConfigError, match=r"bus\.endpoint"):
        Bus(config, "plant", "plant-a").open()
    assert router.main(config) == 2


def test_a_port_in_use_gives_a_readable_error(config: Config, caplog: pytest.LogCaptureFixture) -> None:
    assert router.main(config) == 1
    assert "is in use: another router may be running" in caplog.text
    assert config.bus.endpoint in caplog.text


@pytest.mark.parametrize(
    ("endpoint", "says"),
    [
        ("tcp/203.0.113.9:7447", "tcp/203.0.113.9:7447: this machine does not have that address"),
        ("tcp/nosuch.invalid:7447", "tcp/nosuch.invalid:7447: the name is not known here"),
        ("tcp/127.0.0.1:99999", "tcp/127.0.0.1:99999: a port is a number from 1 to 65535"),
    ],
)
def test_a_router_that_cannot_listen_reports_the_cause(
    endpoint: str, says: str, caplog: pytest.LogCaptureFixture
) -> None:
    assert router.main(override(Config(), [f'bus.endpoint="{endpoint}"', "bus.insecure=true"])) == 1
    assert says in caplog.text
    assert ".rs:" not in caplog.text


def test_the_endpoint_in_use_is_named(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    certificate_authority.create("jet1", [], tmp_path / "keys", 30)
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        taken = f"tls/127.0.0.1:{other.getsockname()[1]}"
        keys = f'bus.tls.keys="{tmp_path}/keys/router"'
        assert router.main(live_config(f'bus.remote="{taken}"', keys)) == 1
    assert f"{taken} is in use: another router may be running, or another program" in caplog.text


def test_the_router_process_ends_cleanly() -> None:
    config = override(live_config(), [f'bus.endpoint="{free_endpoint()}"'])
    with Process("node_runtime.router", config) as process, Bus(config, "recorder", "r-1") as bus:
        mailbox = bus.queue(topics.HEALTH["router"])
        assert mailbox.get(HANG_S) is not None
        process.signal(signal.SIGINT)
        assert process.end() == 0
        assert "Traceback" not in process.said
