"""Writes the log of a run as MCAP. The file is readable up to the last flush if the process dies.

- `raw/<topic>`: the exact bytes of the messages (msgpack), for replay, in a protobuf message of one field
  (`run_log.raw_message`). The attachment schemas.json has the schemas of the bytes.
- `view/<topic>`, `view/bounds`, `view/targets`, `view/events`: plottable JSON with JSON schemas (`run_log.views`).
- metadata: identity of the log, its clock, units, versions, seeds and configuration.
- attachments: config.json, config.toml, plant.json (the known plant, as numbers), versions.json, seeds.json,
  units.json, schemas.json.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import msgspec

from lbmpc.plants import Known, Plant
from node_runtime import provenance
from node_runtime.config.loading import to_json, to_toml, to_tree
from node_runtime.config.sections import Config
from node_runtime.config.strict import readable
from protocol import codec, topics
from run_log import raw_message
from run_log.errors import LogError
from run_log.file_format import (
    CONFIG,
    CONFIGURATION,
    CONTINUED,
    FORMAT,
    IDENTITY,
    LIBRARY,
    PLANT,
    PROFILE,
    RAW,
    SEEDS,
    TIMES,
    UNITS,
    UNIX_CLOCK,
    VERSIONS_USED,
)
from run_log.plant_record import encode
from run_log.views.channel import Channel
from run_log.views.views import Views
from run_log.writing.durable_file import Sink, mcap_writer
from run_log.writing.user_budget import UserBudget

MAX_MESSAGE = 4 * topics.WEIGHTS_LIMIT
MAX_STRANGERS = 100
"""Largest number of channels for unknown keys; messages on further unknown keys are not logged."""


class LogWriter:
    """One log file.

    Args:
        path: a file that does not exist yet.
        config: the resolved configuration.
        plant: the plant that `config` names; its names and units label the views.
        files: the sha256 of the plant's files, by key of the configuration.
        start_ns: time of the attachments, in the same clock as the messages.
        versions: the versions that ran; None: the packages installed here.
        patient: see `Sink`.
        part: number of this part of the run, from 1 (`run_log.writing.parts`).
        clock: description of the clock of the message times.

    Raises:
        LogExistsError: `path` exists already.
        LogError: not patient, and the file cannot be created.
    """

    def __init__(
        self,
        path: str | Path,
        config: Config,
        plant: Known | Plant,
        files: Mapping[str, str] | None = None,
        *,
        start_ns: int = 0,
        versions: dict[str, str] | None = None,
        patient: bool = False,
        part: int = 1,
        clock: str = UNIX_CLOCK,
    ):
        self.counters = {
            "messages": 0,
            "bytes": 0,
            "without_view": 0,
            "dropped": 0,
            "user_dropped": 0,
            "lost_ticks": 0,
        }
        self.bad: dict[str, int] = {}
        """Number of payloads of known topics that are logged without a view, by reason."""
        self.last_bad: str | None = None
        self.sink = Sink(path, patient=patient)
        self._views = Views(config, plant)
        self._budget = UserBudget()
        self._raw: dict[str, int] = {}
        self._raw_schema: int | None = None
        self._shown: dict[Channel, int] = {}
        self._strangers = 0
        self._mcap = mcap_writer(self.sink, config.log.chunk_bytes)
        self._mcap.start(profile=PROFILE, library=LIBRARY)
        versions = versions if versions is not None else provenance.versions()
        identity = {"format": str(FORMAT), "name": config.name, "plant": plant.name, "part": str(part)}
        self._mcap.add_metadata(IDENTITY, {**identity, "clock": clock, **TIMES})
        for name, values in _metadata(config, plant, versions).items():
            self._mcap.add_metadata(name, {key: readable(value) for key, value in values.items()})
        for name, kind, text in _attachments(config, plant, files or {}, versions):
            self._mcap.add_attachment(start_ns, start_ns, name, kind, text.encode())
        self.flush()

    @property
    def lost(self) -> dict[str, int]:
        """Number of lost messages, by topic: gaps between the numbers that arrived."""
        return self._views.lost

    def write(self, name: str, payload: bytes, log_time: int) -> None:
        """Log a message of topic `name` (its key below `tandem/<plant>/`), valid or not; `log_time` in ns.

        An invalid payload is logged unchanged, without a view. Bad input and a full disk raise no exception: see
        `counters`, `bad` and `sink.error`.
        """
        if len(payload) > MAX_MESSAGE or self.sink.pending > self.sink.limit:
            self.counters["dropped"] += 1
            return
        if topics.is_user(name) and not self._budget.admit(name, len(payload), log_time):
            self.counters["user_dropped"] += 1
            return
        channel = self._raw.get(name) or self._register_raw(name)
        if channel is None:
            self.counters["dropped"] += 1
            return
        seen = self._views.show(name, payload, log_time)
        if seen.bad is not None:
            self._count_bad(seen.bad)
        sequence = seen.seq & 0xFFFFFFFF
        self._mcap.add_message(channel, log_time, raw_message.wrap(payload), seen.sent_ns, sequence)
        for shown, text in seen.shown:
            self._mcap.add_message(self._view_channel(shown), log_time, text, seen.sent_ns, sequence)
        if self._views.lost:
            self.counters["lost_ticks"] = max(self._views.lost.values())
        self.counters["messages"] += 1
        self.counters["bytes"] += len(payload)

    def flush(self) -> bool:
        """End the chunk and write all data; return False if the operating system does not accept all of it."""
        self._mcap.flush()
        return self.sink.error is None

    def close(self, continued: Path | None = None) -> None:
        """Write the index and close.

        continued: the part in which the log continues; None: it is the last.

        Raises:
            LogError: the file is incomplete; `tandem recover` saves its messages.
        """
        if continued is not None:
            self._mcap.add_metadata(CONTINUED, {"in": readable(continued.name)})
        self._mcap.finish()
        if not self.sink.close():
            raise LogError(f"{self.sink.error}; the log is incomplete: `tandem recover` saves its messages")

    def __enter__(self) -> LogWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _register_raw(self, name: str) -> int | None:
        topic = topics.BY_NAME.get(name)
        if topic is None and not topics.is_user(name):
            if self._strangers >= MAX_STRANGERS:
                return None
            self._strangers += 1
        if self._raw_schema is None:
            self._raw_schema = self._mcap.register_schema(
                raw_message.SCHEMA_NAME, raw_message.ENCODING, raw_message.schema()
            )
        # The encoding of an unknown topic is not known.
        inside = {"type": topic.type.__name__, "payload": "msgpack"} if topic else {"type": "unknown"}
        self._raw[name] = self._mcap.register_channel(
            RAW + name, raw_message.ENCODING, self._raw_schema, inside
        )
        return self._raw[name]

    def _view_channel(self, channel: Channel) -> int:
        if channel not in self._shown:
            schema = self._mcap.register_schema(channel.schema_name, "jsonschema", channel.schema_text)
            self._shown[channel] = self._mcap.register_channel(channel.topic, "json", schema)
        return self._shown[channel]

    def _count_bad(self, error: codec.BadMessage) -> None:
        key = f"{error.topic}: {error.reason}"
        self.bad[key] = self.bad.get(key, 0) + 1
        self.counters["without_view"] += 1
        self.last_bad = str(error)


def _metadata(config: Config, plant: Known | Plant, versions: Mapping[str, str]) -> dict[str, dict[str, str]]:
    return {
        UNITS: dict(plant.units),
        VERSIONS_USED: dict(versions),
        SEEDS: {"seed": str(config.seed)},
        CONFIGURATION: dict(_flat(to_tree(config))),
    }


def _flat(tree: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, str]]:
    """Yield every key of a configuration, with its sections, and its value as JSON; texts stay unquoted."""
    for key, value in tree.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{before}{key}.")
        else:
            yield before + key, value if isinstance(value, str) else json.dumps(value)


def _attachments(
    config: Config, plant: Known | Plant, files: Mapping[str, str], versions: dict[str, str]
) -> list[tuple[str, str, str]]:
    _, schemas = msgspec.json.schema_components([topic.type for topic in topics.ALL])
    channels = {RAW + topic.name: topic.type.__name__ for topic in topics.ALL}
    as_json = "application/json"
    return [
        (CONFIG, as_json, msgspec.json.format(to_json(config))),
        ("config.toml", "application/toml", to_toml(config)),
        (PLANT, as_json, encode(plant, files)),
        ("versions.json", as_json, json.dumps(versions, indent=2)),
        ("seeds.json", as_json, json.dumps({"seed": config.seed})),
        ("units.json", as_json, json.dumps(plant.units, indent=2)),
        ("schemas.json", as_json, json.dumps({"channels": channels, "types": schemas}, indent=2)),
    ]
