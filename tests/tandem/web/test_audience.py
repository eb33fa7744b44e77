"""Viewers and channels: delivery in bounded memory, and refused requests."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import pytest

from run_log.views.channel import Channel, document, leaf
from tandem.web.audience import WAITING_BYTES, WAITING_REFUSALS, Audience, Viewer
from tandem.web.foxglove_protocol import HEADER, MESSAGE_DATA


def channel(name: str, *fields: str) -> Channel:
    return Channel(name, document(name, dict.fromkeys(fields, leaf("number")), fields))


STATE, EVENTS = channel("plant/state", "t"), channel("events", "text")


@pytest.fixture
def audience() -> Audience:
    """Two channels: the server keeps two events, and no state."""
    there = Audience("a name", "a session", {"plant": "jet1"}, lambda topic: 2 if "events" in topic else 0)
    for one in (STATE, EVENTS):
        there.advertise(one)
    return there


def frames(viewer: Viewer) -> list[Any]:
    """Return the waiting data: text as objects, messages as (subscription, time in ns, payload)."""

    def drain() -> Iterator[str | bytes]:
        while viewer._words or viewer._data:
            try:
                viewer.next_frame().send(None)
            except StopIteration as frame:
                yield frame.value

    def read(frame: str | bytes) -> Any:
        if isinstance(frame, str):
            return json.loads(frame)
        opcode, subscription, time_ns = HEADER.unpack_from(frame)
        assert opcode == MESSAGE_DATA
        return subscription, time_ns, frame[HEADER.size :]

    return [read(frame) for frame in drain()]


def subscribe(audience: Audience, viewer: Viewer, *pairs: tuple[int, int]) -> None:
    asked = [{"id": number, "channelId": to} for number, to in pairs]
    audience.obey(viewer, json.dumps({"op": "subscribe", "subscriptions": asked}))


def test_a_new_viewer_receives_the_server_info_and_all_channels(audience: Audience):
    info, advertised = frames(audience.enter())
    assert info["op"] == "serverInfo"
    assert (info["name"], info["sessionId"], info["metadata"]) == ("a name", "a session", {"plant": "jet1"})
    assert info["capabilities"] == []
    assert [one["topic"] for one in advertised["channels"]] == ["view/plant/state", "view/events"]
    first = advertised["channels"][0]
    assert (first["encoding"], first["schemaEncoding"]) == ("json", "jsonschema")
    assert json.loads(first["schema"]) == STATE.schema


def test_a_viewer_gets_what_it_subscribed_to_under_its_own_numbers(audience: Audience):
    viewer, other = audience.enter(), audience.enter()
    frames(viewer), frames(other)
    subscribe(audience, viewer, (77, 1))
    audience.publish(STATE, 5, b'{"t":1}')
    audience.publish(EVENTS, 6, b"{}")
    assert frames(viewer) == [(77, 5, b'{"t":1}')]
    assert frames(other) == []
    audience.obey(viewer, '{"op":"unsubscribe","subscriptionIds":[77, 3]}')
    audience.publish(STATE, 7, b'{"t":2}')
    assert frames(viewer) == []


def test_a_late_viewer_gets_the_latest_kept_messages(audience: Audience):
    for time_ns in (1, 2, 3):
        audience.publish(EVENTS, time_ns, b"%d" % time_ns)
        audience.publish(STATE, time_ns, b"%d" % time_ns)
    viewer = audience.enter()
    frames(viewer)
    subscribe(audience, viewer, (1, 1), (2, 2))
    assert frames(viewer) == [(2, 2, b"2"), (2, 3, b"3")]


def test_a_channel_with_more_fields_takes_the_place_of_the_former(audience: Audience):
    audience.publish(EVENTS, 1, b"old")
    viewer = audience.enter()
    frames(viewer)
    subscribe(audience, viewer, (9, 2))
    frames(viewer)
    wider = channel("events", "text", "count")
    audience.publish(wider, 2, b"new")
    gone, come = frames(viewer)
    assert gone == {"op": "unadvertise", "channelIds": [2]}
    (now,) = come["channels"]
    assert now["id"] not in (1, 2)
    assert json.loads(now["schema"]) == wider.schema
    assert viewer.subscriptions == {}
    # The viewer must subscribe again, and receives every kept message.
    subscribe(audience, viewer, (9, now["id"]))
    assert frames(viewer) == [(9, 1, b"old"), (9, 2, b"new")]
    late = audience.enter()
    assert [one["id"] for one in frames(late)[1]["channels"]] == [1, now["id"]]


def test_a_viewer_that_does_not_read_loses_the_oldest_and_takes_bounded_memory(audience: Audience):
    slow, quick = audience.enter(), audience.enter()
    frames(quick)
    subscribe(audience, slow, (1, 1))
    subscribe(audience, quick, (1, 1))
    payload = bytes(10_000)
    sent = 3 * WAITING_BYTES // len(payload)
    for time_ns in range(sent):
        audience.publish(STATE, time_ns, payload)
        assert frames(quick) == [(1, time_ns, payload)]
        assert slow._bytes <= WAITING_BYTES
    waiting = [time_ns for _, time_ns, _ in frames(slow)[2:]]
    assert waiting == list(range(slow.dropped, sent))
    assert slow.dropped > sent // 2
    assert quick.dropped == 0


@pytest.mark.parametrize(
    "asked",
    [
        '{"op":"advertise","channels":[{"id":1,"topic":"x","encoding":"json","schemaName":""}]}',
        '{"op":"setParameters","parameters":[{"name":"a","value":1}]}',
        '{"op":"getParameters","parameterNames":[]}',
        '{"op":"subscribeConnectionGraph"}',
        '{"op":"fetchAsset","uri":"package://a","requestId":1}',
        b"\x01\x01\x00\x00\x00{}",
        b"\x02\x01\x00\x00\x00",
    ],
)
def test_nothing_else_is_offered(audience: Audience, asked: str | bytes):
    viewer = audience.enter()
    frames(viewer)
    audience.obey(viewer, asked)
    (said,) = frames(viewer)
    assert (said["op"], said["level"]) == ("status", 2)
    assert "publishes nothing" in said["message"]


@pytest.mark.parametrize(
    "asked",
    [
        "",
        "[]",
        "{}",
        "nonsense",
        '{"op":5}',
        '{"op":"subscribe"}',
        '{"op":"subscribe","subscriptions":[{"id":"a","channelId":1}]}',
        '{"op":"subscribe","subscriptions":[{"id":-1,"channelId":1}]}',
        '{"op":"subscribe","subscriptions":[{"id":4294967296,"channelId":1}]}',
        '{"op":"subscribe","subscriptions":[{"id":1,"channelId":99}]}',
        "[" * 100_000,
        '{"op":"unsubscribe","subscriptionIds":5}',
    ],
)
def test_an_invalid_request_is_refused_and_changes_nothing(audience: Audience, asked: str):
    viewer = audience.enter()
    frames(viewer)
    audience.obey(viewer, asked)
    (said,) = frames(viewer)
    assert (said["op"], said["level"]) == ("status", 2)
    assert viewer.subscriptions == {}


def test_a_second_subscription_to_a_channel_is_refused_and_the_first_stays(audience: Audience):
    viewer = audience.enter()
    frames(viewer)
    subscribe(audience, viewer, (1, 1), (2, 1))
    assert [said["op"] for said in frames(viewer)] == ["status"]
    assert viewer.subscriptions == {1: 1}


def test_refusals_that_a_viewer_does_not_read_take_bounded_memory(audience: Audience):
    viewer = audience.enter()
    subscribe(audience, viewer, *((1, 99) for _ in range(10_000)))
    for _ in range(1000):
        audience.obey(viewer, b"")
        audience.obey(viewer, "{}")
    assert len(frames(viewer)) == WAITING_REFUSALS


def test_a_viewer_that_has_left_receives_nothing(audience: Audience):
    viewer = audience.enter()
    subscribe(audience, viewer, (1, 1))
    audience.leave(viewer)
    before = len(frames(viewer))
    audience.publish(STATE, 1, b"{}")
    assert before == 2
    assert frames(viewer) == []
    assert audience.viewers == set()
