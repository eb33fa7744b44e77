"""Reads a log as other people's viewers do, and reports every alert that they would show.

    python -m verification.viewers LOG [LOG ...]

The rules are those of three readers, as their sources state them:

- Lichtblick (and Foxglove, where it comes from): `parseChannel` of packages/mcap-support. It knows the encodings json,
  protobuf, flatbuffer, ros1 and cdr, each with its schema encoding, and refuses a JSON schema with a field that it
  cannot place. A channel that it refuses is a red alert.
- PlotJuggler: its MCAP plugin skips a channel without a schema, and shows a box for an encoding that no parser knows.
- Ours: every JSON message obeys its schema strictly, every object declares its fields, and names of counters have
  no spaces and commas.
"""

from __future__ import annotations

import json
import re
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jsonschema
from mcap.reader import make_reader
from mcap.records import Channel, Schema

from run_log import raw_message

SCHEMA_ENCODINGS = {
    "json": ("jsonschema",),
    "protobuf": ("protobuf",),
    "flatbuffer": ("flatbuffer",),
    "ros1": ("ros1msg",),
    "cdr": ("ros2msg", "ros2idl", "omgidl"),
}
"""Lichtblick: by the encoding of a channel, those of its schema. Only JSON may have none."""
PLOTJUGGLER = ("json", "cbor", "bson", "msgpack", "protobuf", "ros1msg", "ros2msg", "ros2idl", "omgidl")
"""Encodings of channels or schemas that PlotJuggler has a parser for."""
MOST = 10_000_000
"""Messages of one log that are looked at."""
NAME = re.compile("[A-Za-z0-9_]+")

Alert = tuple[str, str]
"""The channel, and what is wrong with it."""


def alerts(path: Path) -> dict[Alert, int]:
    """Return all alerts of a log, and of how many channels or messages each is."""
    found: Counter[Alert] = Counter()
    validators: dict[int, jsonschema.Draft202012Validator] = {}
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        if summary is None:
            return {("the file", "has no summary: it was cut short"): 1}
        for channel in summary.channels.values():
            schema = summary.schemas.get(channel.schema_id)
            found.update((channel.topic, text) for text in _of_channel(channel, schema))
        for number, (schema, channel, message) in enumerate(reader.iter_messages()):
            if number >= MOST:
                break
            if channel.message_encoding == "json" and schema is not None:
                if schema.id not in validators:
                    validators[schema.id] = _validator(schema)
                wrong = _of_json(message.data, validators[schema.id])
                found.update((channel.topic, text) for text in wrong)
            elif schema is not None and schema.name == raw_message.SCHEMA_NAME:
                try:
                    raw_message.unwrap(message.data)
                except raw_message.NotRaw as error:
                    found[channel.topic, str(error)] += 1
            if message.publish_time > message.log_time:
                found[channel.topic, "a message was sent after it arrived"] += 1
    return dict(found)


def _of_channel(channel: Channel, schema: Schema | None) -> Iterator[str]:
    encoding = channel.message_encoding
    if schema is None:
        yield "PlotJuggler skips it: it has no schema"
        if channel.schema_id != 0:
            yield f"Lichtblick: missing schema info for schema id {channel.schema_id}"
            return
    elif encoding not in PLOTJUGGLER and schema.encoding not in PLOTJUGGLER:
        yield f"PlotJuggler: no parser available for encoding [{encoding}] nor [{schema.encoding}]"
    if encoding not in SCHEMA_ENCODINGS:
        yield f"Lichtblick: unsupported encoding {encoding}"
        return
    expected = SCHEMA_ENCODINGS[encoding]
    if schema is None:
        if encoding != "json":
            yield f"Lichtblick: encoding {encoding} with no schema (expected {' or '.join(expected)})"
    elif schema.encoding not in expected:
        yield f"Lichtblick: encoding {encoding} with schema encoding {schema.encoding!r} is not supported"
    elif encoding == "json":
        yield from _of_schema(schema)
    elif encoding == "protobuf" and (schema.name, schema.data) != (
        raw_message.SCHEMA_NAME,
        raw_message.schema(),
    ):
        yield "a protobuf schema that is not Tandem's own"


def _of_schema(schema: Schema) -> Iterator[str]:
    try:
        tree = json.loads(schema.data)
    except ValueError as error:
        yield f"Lichtblick: the schema is no JSON: {error}"
        return
    try:
        jsonschema.Draft202012Validator.check_schema(tree)
    except jsonschema.SchemaError as error:
        yield f"the schema is no JSON schema: {error.message}"
    yield from _fields(tree, schema.name)


def _validator(schema: Schema) -> jsonschema.Draft202012Validator:
    """Return a validator of its messages; it accepts everything if the schema itself is an alert."""
    try:
        tree = json.loads(schema.data)
        jsonschema.Draft202012Validator.check_schema(tree)
    except (ValueError, jsonschema.SchemaError):
        tree = {}
    return jsonschema.Draft202012Validator(tree)


def _fields(tree: Any, where: str) -> Iterator[str]:
    """What `parseJsonSchema` of Lichtblick refuses in an object, and what we refuse ourselves."""
    if not isinstance(tree, dict) or tree.get("type") != "object":
        yield f'Lichtblick: expected "type": "object" for schema {where}'
        return
    if not tree.get("properties"):
        yield f"{where} is an object without declared fields"
    if tree.get("additionalProperties") is not False:
        yield f"{where} may have fields that are not declared"
    for name, field in tree.get("properties", {}).items():
        inner = f"{where}.{name}"
        if where.endswith(".counters") and not NAME.fullmatch(name):
            yield f"{inner}: the name of a counter has other characters than letters, digits and _"
        if "oneOf" in field:
            if not all(type(one.get("const")) in (int, float) for one in field["oneOf"]):
                yield f"Lichtblick: unsupported type for {inner}: oneOf alternatives must have number values"
            continue
        kind = field.get("type")
        if kind == "array":
            items = field.get("items", {})
            if items.get("type") == "object":
                yield from _fields(items, inner)
            elif items.get("type") not in ("boolean", "string", "number", "integer"):
                yield f"Lichtblick: unsupported type {items.get('type')!r} for array item {inner}"
        elif kind == "object":
            yield from _fields(field, inner)
        elif kind not in ("boolean", "string", "number", "integer"):
            yield f"Lichtblick: unsupported type {kind!r} for {inner}"
        elif field.get("contentEncoding") not in (None, "base64"):
            yield f"Lichtblick: unsupported contentEncoding {field['contentEncoding']!r} in {inner}"


def _of_json(data: bytes, validator: jsonschema.Draft202012Validator) -> Iterator[str]:
    def refuse(name: str) -> None:
        raise ValueError(f"{name} is not JSON")

    try:
        value = json.loads(data, parse_constant=refuse)
    except ValueError as error:
        yield f"a message is no JSON: {error}"
        return
    for found in validator.iter_errors(value):
        yield f"a message does not obey its schema: at {found.json_path}: {found.message[:120]}"


def main(paths: list[str]) -> int:
    """0 where no viewer would show an alert."""
    if not paths:
        sys.stderr.write("usage: python -m verification.viewers LOG [LOG ...]\n")
        return 2
    total = 0
    for path in paths:
        found = alerts(Path(path))
        total += len(found)
        sys.stdout.write(f"{path}: {len(found)} alerts\n")
        for (topic, text), count in sorted(found.items()):
            sys.stdout.write(f"  {topic}: {text}" + (f" ({count} times)\n" if count > 1 else "\n"))
    return 1 if total else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
