"""The rules of other people's viewers: no alert in a log of ours, and one for each kind of fault."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from mcap.writer import Writer

from node_runtime.config.loading import override
from node_runtime.config.sections import Config
from run_log.writing.save import save
from tandem.experiments.simulation.lockstep import simulate
from tests.run_log.test_format_2 import LOG as FORMAT_2
from verification.viewers import alerts, main

PLAIN = {"type": "object", "properties": {"x": {"type": "number"}}, "additionalProperties": False}


def test_a_log_of_ours_has_no_alert(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = override(Config(), ["controller.horizon=5", "network.hidden=[6]", "trainer.steps=5"])
    path = tmp_path / "run.mcap"
    save(simulate(config, 12), path)
    assert alerts(path) == {}
    assert main([str(path)]) == 0
    assert capsys.readouterr().out == f"{path}: 0 alerts\n"


def test_a_log_of_format_2_has_the_alerts_that_format_3_is_for() -> None:
    found = alerts(FORMAT_2)
    raw = {topic for topic, text in found if text == "Lichtblick: unsupported encoding msgpack"}
    assert len(raw) == 10
    assert all(topic.startswith("raw/") for topic in raw)
    assert main([str(FORMAT_2)]) == 1


@pytest.mark.parametrize(
    ("encoding", "schema", "message", "alert"),
    [
        ("json", None, b"{}", "PlotJuggler skips it"),
        ("msgpack", ("msgpack", b""), b"", "Lichtblick: unsupported encoding msgpack"),
        ("octets", ("octets", b""), b"", "PlotJuggler: no parser available"),
        ("protobuf", ("jsonschema", b"{}"), b"", "with schema encoding 'jsonschema' is not supported"),
        ("json", ("jsonschema", b"{"), b"{}", "the schema is no JSON"),
        ("json", {"type": "array"}, b"[]", 'expected "type": "object"'),
        ("json", {**PLAIN, "properties": {"x": {"type": "null"}}}, b"{}", "unsupported type 'null' for s.x"),
        (
            "json",
            {**PLAIN, "properties": {"x": {"type": "object"}}},
            b"{}",
            "s.x is an object without declared",
        ),
        ("json", PLAIN, b'{"x": "text"}', "a message does not obey its schema: at $.x"),
        ("json", PLAIN, b'{"x": NaN}', "a message is no JSON: NaN is not JSON"),
        ("json", PLAIN, b'{"x": 1', "a message is no JSON"),
    ],
)
def test_each_fault_is_found(tmp_path: Path, encoding: str, schema: Any, message: bytes, alert: str) -> None:
    path = tmp_path / "x.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="", library="")
        number = 0
        if schema is not None:
            kind, data = ("jsonschema", json.dumps(schema).encode()) if isinstance(schema, dict) else schema
            number = writer.register_schema("s", kind, data)
        channel = writer.register_channel("topic", encoding, number)
        writer.add_message(channel, 1, message, 1)
        writer.finish()
    assert any(alert in text for _, text in alerts(path)), alerts(path)
