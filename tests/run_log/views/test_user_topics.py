"""User topics are recorded byte for byte, shown without a schema, bounded, and ignored by a replay."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jsonschema
import msgpack
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lbmpc.plants import get_plant
from protocol import topics
from run_log.reading.reader import read_run
from run_log.views.channel import MOST_SCHEMAS
from run_log.views.user_topics import MOST_LEAVES, UserView
from run_log.views.views import MOST_USER_TOPICS, Views
from run_log.writing import user_budget
from run_log.writing.writer import LogWriter
from tests.run_log.samples import Config, synthetic, write
from verification.viewers import alerts

PLANT = get_plant("moore_greitzer")


def shown(view: UserView, payload: bytes) -> Any:
    found = view.render(payload)
    if found is None:
        return None
    value = json.loads(found.data)
    jsonschema.Draft202012Validator.check_schema(found.channel.schema)
    jsonschema.validate(value, found.channel.schema)
    return value


@pytest.mark.parametrize(
    ("payload", "expected"),
    [
        (b'{"wind": 3.5, "gust": true}', {"wind": 3.5, "gust": True}),
        (b"21.5", {"value": 21.5}),
        (b"[1, 2.5]", {"value": [1, 2.5]}),
        (b"valve opened", {"value": "valve opened"}),
        ("größer".encode(), {"value": "größer"}),
        (msgpack.packb({"a": 1, "b": {"c": [1.0, 2.0]}}), {"a": 1, "b": {"c": [1.0, 2.0]}}),
        (msgpack.packb([{"x": 1}, {"x": 2}]), {"value": {"item_0": {"x": 1}, "item_1": {"x": 2}}}),
        (msgpack.packb({1: 2, "t": msgpack.Timestamp(5, 500_000_000)}), {"1": 2, "t": 5.5}),
        (msgpack.packb({"raw": bytes(100), "nan": float("nan"), "none": None}), {"raw": "100 bytes"}),
        (b"\xc1\x00\xff", {"value": "3 bytes"}),
        (b'{"big": 123456789012345678901234567890}', {"big": 1.2345678901234568e29}),
        (b'{"half": "\\ud800"}', {"half": "?"}),
        (b"{}", None),
    ],
)
def test_the_view_of_a_payload(payload: bytes, expected: Any) -> None:
    assert shown(UserView("user/x"), payload) == expected


def test_a_field_is_declared_when_it_comes_and_keeps_its_kind() -> None:
    view = UserView("user/x")
    assert shown(view, b'{"a": 1}') == {"a": 1}
    first = view.channel
    assert shown(view, b'{"a": 2.5}') == {"a": 2.5}
    assert view.channel is first
    assert shown(view, b'{"a": "text", "b": {"c": 1}}') == {"b": {"c": 1}}
    assert view.channel is not first
    assert shown(view, b'{"b": 3, "a": 4}') == {"a": 4}


@settings(max_examples=40, deadline=None)
@given(
    st.lists(
        st.binary(max_size=60)
        | st.recursive(
            st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
            lambda inner: (
                st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=3), inner, max_size=4)
            ),
            max_leaves=20,
        ).map(lambda value: json.dumps(value).encode()),
        max_size=6,
    )
)
def test_no_payload_breaks_a_view(payloads: list[bytes]) -> None:
    view = UserView("user/x")
    for payload in payloads:
        shown(view, payload)


def test_fields_and_schemas_are_bounded() -> None:
    view, channels = UserView("user/x"), set()
    for k in range(10 * MOST_SCHEMAS):
        view.render(json.dumps({f"f{k}_{i}": i for i in range(3)}).encode())
        channels.add(view.channel)
    assert len(channels) <= MOST_SCHEMAS
    wide = UserView("user/x")
    assert len(shown(wide, json.dumps({f"f{i}": i for i in range(10 * MOST_LEAVES)}).encode())) == MOST_LEAVES


@pytest.mark.parametrize(
    "payload",
    [
        b'{"a":' * 500 + b"1" + b"}" * 500,
        b"[" * 900 + b"1" + b"]" * 900,
        b"\x91" * 500 + b"\x01",
    ],
    ids=["objects", "lists", "msgpack"],
)
def test_a_deep_message_has_no_view(payload: bytes) -> None:
    assert shown(UserView("user/x"), payload) is None


def test_a_message_beyond_the_limit_has_no_view() -> None:
    views = Views(Config(), PLANT)
    largest = b"1" * topics.USER_MAX_BYTES
    assert views.show("user/x", largest, 0).shown
    assert not views.show("user/y", largest + b"1", 0).shown


def test_they_are_in_the_log_and_a_viewer_has_no_alert(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    sent = [msgpack.packb({"wind": k * 0.5}) for k in range(50)] + [b"\xc1"]
    _, messages = synthetic(steps=30)
    with LogWriter(path, Config(), PLANT) as writer:
        for k, payload in enumerate(sent):
            writer.write("user/weather/wind", payload, k * 20_000_000)
        writer.write("user/note", b"valve opened", 0)
        assert writer.counters["user_dropped"] == 0
    run = read_run(path)
    assert [payload for _, payload in run.user["user/weather/wind"]] == sent
    assert run.user["user/note"] == [(0, b"valve opened")]
    assert run.strangers == {}
    assert alerts(path) == {}
    assert alerts(write(tmp_path / "own.mcap", Config(), messages)) == {}


def test_a_flood_is_dropped_and_counted_and_the_plant_is_not(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    large = bytes(topics.USER_MAX_BYTES)
    with LogWriter(path, Config(), PLANT) as writer:
        writer.write("user/large", large + b"x", 0)
        assert writer.counters["user_dropped"] == 1
        for k in range(100):
            writer.write("user/large", large, k)
        whole = int(user_budget.BURST_S * user_budget.BYTES_PER_S) // len(large)
        assert writer.counters["user_dropped"] == 1 + 100 - whole
        writer.write("user/large", large, 10**9)
        assert writer.counters["user_dropped"] == 1 + 100 - whole
    other = tmp_path / "other.mcap"
    with LogWriter(other, Config(), PLANT) as writer:
        for k in range(2 * MOST_USER_TOPICS):
            writer.write(f"user/topic{k}", b"1", k)
        assert writer.counters["user_dropped"] == MOST_USER_TOPICS
        for k in range(10_000):
            writer.write("user/topic0", b"1", k)
        assert writer.counters["messages"] <= user_budget.BURST_S * user_budget.MESSAGES_PER_S
    assert len(read_run(other).user) == MOST_USER_TOPICS
