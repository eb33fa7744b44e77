"""Rights of admitted clients over a real router, and messages that are not delivered."""

from __future__ import annotations

import pytest
import zenoh

from node_runtime.bus.zenoh_bus import Bus, Mailbox
from node_runtime.realtime import clock
from protocol import rights, topics
from protocol.topics import Topic
from tests.helpers.live import HANG_S, matched, wait_for
from tests.node_runtime.tls.site import Site

pytestmark = pytest.mark.live

FOREIGN = [
    ("trainer", topics.COMMAND),
    ("trainer", topics.PLANT_STATE),
    ("trainer", topics.TICK),
    ("trainer", topics.HEALTH["controller"]),
    ("plant", topics.COMMAND),
    ("controller", topics.HIDDEN_WEIGHTS),
    ("controller", topics.PLANT_STATE),
    ("recorder", topics.HIDDEN_WEIGHTS),
    ("viewer", topics.COMMAND),
    ("viewer", topics.OVERRIDE),
    ("viewer", topics.REFERENCE),
    ("commander", topics.COMMAND),
    ("stranger", topics.HIDDEN_WEIGHTS),
    ("neighbour", topics.HIDDEN_WEIGHTS),
]


def _allowed(role: str) -> Topic | None:
    own = rights.rights_of(role).publishes if role in rights.ROLES else ()
    return own[0] if own else None


def _until(mailbox: Mailbox, key: str, timeout_s: float = HANG_S) -> list[str]:
    """Return the keys of all messages up to and including the first at `key`."""
    keys: list[str] = []
    deadline = clock.now() + timeout_s
    while key not in keys:
        assert clock.now() < deadline, f"nothing at {key}; received {keys}"
        delivery = mailbox.get(0.2)
        if delivery is not None:
            keys.append(delivery.key)
    return keys


@pytest.mark.parametrize("role", dict.fromkeys(role for role, _ in FOREIGN))
def test_messages_without_the_right_to_publish_are_not_delivered(site: Site, role: str):
    """The last message is allowed, so all messages before it have either arrived or never will."""
    with Bus(site.local, "viewer", "o-1") as ear, site.session(role) as session:
        heard, block = ear.everything(), zenoh.CongestionControl.BLOCK
        fast = ear._lanes.session("bulk").declare_subscriber(topics.COMMAND.direct_key("jet1"))
        # Now the router knows the subscriber.
        _until(heard, topics.HEALTH["router"].key("jet1"))
        for name, topic in FOREIGN:
            if name == role:
                session.put(topic.key("jet1"), b"bad", congestion_control=block)
        if role != "controller":
            session.put(topics.COMMAND.direct_key("jet1"), b"bad")
        session.put("tandem/jet2/trainer/hidden_weights", b"bad")
        session.delete("tandem/jet1/controller/command")
        own = _allowed(role)
        if own is not None:
            session.put(own.key("jet1"), b"good", congestion_control=block)
        # For a role that may publish nothing, the router's next two messages mark the end.
        last = own.key("jet1") if own is not None else topics.HEALTH["router"].key("jet1")
        arrived = [key for _ in range(1 if own else 2) for key in _until(heard, last)]
        assert set(arrived) <= {last, *(f"tandem/jet1/router/{name}" for name in ("health", "run_info"))}
        assert fast.try_recv() is None
    named = {
        "stranger": "a certificate without rights here",
        "neighbour": "a certificate without rights here",
    }
    site.router.heard(named.get(role, f"bad from {role}.jet1: denied, put"))


def test_a_trainer_receives_no_commands_and_answers_no_queries(site: Site):
    with (
        Bus(site.local, "controller", "c-1") as controller,
        Bus(site.local, "trainer", "t-2") as asker,
        site.session("trainer") as session,
    ):
        heard = [
            session.declare_subscriber(key)
            for key in ("tandem/**", "tandem/jet1/**", "tandem/jet1/*/command")
        ]
        samples = session.declare_subscriber(topics.SAMPLES.key("jet1"), zenoh.handlers.RingChannel(8))
        false_answers = session.declare_queryable(
            f"tandem/jet1/{topics.OUTBOX_QUERY}",
            lambda query: query.reply(query.key_expr, b"false"),
            complete=True,
        )
        controller.serve(topics.OUTBOX_QUERY, lambda _parameters: [b"true"])
        wait_for(lambda: matched(controller, topics.SAMPLES))
        controller._put(topics.COMMAND, b"command")
        controller._put(topics.SAMPLES, b"samples")
        sample = samples.recv()
        assert sample.payload.to_bytes() == b"samples"
        assert asker.ask(topics.OUTBOX_QUERY, {}, HANG_S) == [b"true"]
        commands = [
            one for sub in heard for one in iter(sub.try_recv, None) if "command" in str(one.key_expr)
        ]
        assert commands == []
        false_answers.undeclare()


def test_the_router_drops_oversized_messages(site: Site):
    health = topics.HEALTH["trainer"]
    with Bus(site.local, "recorder", "r-1") as ear, site.session("trainer") as session:
        heard = ear._lanes.session("bulk").declare_subscriber(health.key("jet1"))
        own = session.declare_publisher(health.key("jet1"))
        wait_for(lambda: own.matching_status.matching)
        block = zenoh.CongestionControl.BLOCK
        session.put(health.key("jet1"), bytes(health.max_bytes + 1), congestion_control=block)
        session.put(health.key("jet1"), bytes(health.max_bytes), congestion_control=block)
        assert len(heard.recv().payload) == health.max_bytes
