"""The log of a run: it contains every message, foreign readers can read it, and it survives a full disk."""

from __future__ import annotations

import json
import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jsonschema
import msgpack
import msgspec
import numpy as np
import pytest
from mcap.reader import make_reader

from lbmpc.plants import get_plant
from node_runtime.config.loading import from_json
from node_runtime.config.sections import Config
from protocol import codec, topics
from protocol import messages as m
from run_log.errors import LogError, LogExistsError
from run_log.raw_message import unwrap
from run_log.reading.reader import read_run
from run_log.run import gather
from run_log.writing.durable_file import Sink
from run_log.writing.save import save
from run_log.writing.writer import LogWriter
from tests.run_log.samples import STEPS, Logged, logged, payloads

PLANT = get_plant("moore_greitzer")


# -- writing and reading ---------------------------------------------------------------------------------


def test_every_byte_comes_back(whole: Path, config: Config, messages: list[Logged]) -> None:
    run = read_run(whole)
    assert not run.truncated
    assert not run.recovered
    assert run.config == config
    assert logged(whole) == payloads(messages)
    assert len(run.ticks) == len(run.results) == len(run.commands) == STEPS
    assert (
        run.entries(topics.COMMAND)[3].log_time
        == [t for topic, _, t in messages if topic is topics.COMMAND][3]
    )
    assert [info.process for info in run.run_infos] == ["controller"]
    assert len(run.samples) == STEPS - 1


def test_attachments_have_versions_configuration_and_plant(whole: Path, config: Config) -> None:
    attached = read_run(whole).attachments
    assert from_json(attached["config.json"].decode()) == config
    assert b"keyframe_every = 20" in attached["config.toml"]
    assert json.loads(attached["seeds.json"]) == {"seed": 7}
    assert json.loads(attached["units.json"])["rdot"] == "1/s"
    assert json.loads(attached["versions.json"]) == {"python": "3.11"}
    schemas = json.loads(attached["schemas.json"])
    assert schemas["channels"]["raw/controller/tick"] == "Tick"
    assert "state_verdict" in schemas["types"]["Tick"]["properties"]


def test_metadata_has_units_versions_configuration_and_the_clock(whole: Path, config: Config) -> None:
    with whole.open("rb") as stream:
        found = {record.name: record.metadata for record in make_reader(stream).iter_metadata()}
    assert found["tandem"]["clock"] == "Unix time of the machine that recorded"
    assert found["tandem"]["log_time"] == "arrival at the recorder"
    assert found["units"]["rdot"] == "1/s"
    assert (found["seeds"], found["versions"]) == ({"seed": "7"}, {"python": "3.11"})
    assert found["configuration"]["controller.keyframe_every"] == "20"
    assert found["configuration"]["controller.solver.mode"] == config.controller.solver.mode


def test_a_foreign_reader_reads_every_message(whole: Path, messages: list[Logged]) -> None:
    raw, views, series = 0, 0, 0
    with whole.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert {a.name for a in reader.iter_attachments()} >= {"config.json", "config.toml", "versions.json"}
        for schema, channel, message in reader.iter_messages():
            if channel.topic.startswith("raw/"):
                assert schema is not None
                assert (channel.message_encoding, schema.encoding, schema.name) == (
                    "protobuf",
                    "protobuf",
                    "tandem_log.Raw",
                )
                assert channel.metadata["payload"] == "msgpack"
                assert msgpack.unpackb(unwrap(message.data))["run_id"]
                raw += 1
            else:
                assert schema is not None
                assert (channel.message_encoding, schema.encoding) == ("json", "jsonschema")
                jsonschema.validate(strict_json(message.data), json.loads(schema.data))
                views += channel.topic.removeprefix("view/") in topics.BY_NAME
                series += channel.topic.removeprefix("view/") not in topics.BY_NAME
        summary = reader.get_summary()
    keyframes = sum(topic is topics.KEYFRAME for topic, _, _ in messages)
    assert raw == len(messages)
    assert views == len(messages) - keyframes
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == raw + views + series


def strict_json(data: bytes) -> Any:
    def refuse(name: str) -> None:
        raise AssertionError(f"{name} is not JSON")

    return json.loads(data, parse_constant=refuse)


def test_views_have_the_plants_names(whole: Path) -> None:
    shown = {}
    with whole.open("rb") as stream:
        for _, channel, message in make_reader(stream).iter_messages():
            shown[channel.topic] = strict_json(message.data) if channel.topic.startswith("view/") else None
    assert set(shown["view/plant/state"]["x"]) == {"z", "y", "r", "rdot"}
    assert set(shown["view/controller/command"]["u"]) == {"u"}
    assert len(shown["view/controller/command"]["plan"]["u"]) == 3
    assert len(shown["view/trainer/hidden_weights"]["layer_norms"]) == 2
    assert set(shown["view/controller/output_weights"]["column_norms"]) == {"z", "y", "r", "rdot"}
    assert "view/controller/keyframe" not in shown


def test_garbage_is_logged_unchanged(tmp_path: Path, config: Config) -> None:
    state = m.PlantState(run_id="p", seq=0, t=0.0, x=[0.0] * 4, applied=None, source="hold", command_seq=-1)
    nan = codec.encode(msgspec.structs.replace(state, x=[float("nan"), 0.0, 0.0, 0.0]))
    short = codec.encode(msgspec.structs.replace(state, x=[1.0, 2.0]))
    bad = [b"", b"\xc1", b"\x93\x01\x02", msgpack.packb({"run_id": 3}), nan, b"\xdd\xff\xff\xff\xff"]
    path = tmp_path / "run.mcap"
    with LogWriter(path, config, PLANT) as writer:
        for i, payload in enumerate([*bad, short, codec.encode(state)]):
            writer.write("plant/state", payload, i)
        writer.write("some/stranger", b"hello", 9)
        for i in range(300):
            writer.write(f"stranger/{i}", b"hello", 10)
        assert writer.counters["without_view"] == len(bad) + 1
        assert writer.counters["dropped"] == 201
        assert writer.bad["plant/state: not finite"] == 1
    run = read_run(path)
    assert run.bad == {"plant/state: malformed": 5, "plant/state: not finite": 1}
    assert [s.x for s in run.plant_states] == [[1.0, 2.0], [0.0] * 4]
    assert run.strangers["some/stranger"] == 1
    with path.open("rb") as stream:
        found = [(c.topic, x.data) for _, c, x in make_reader(stream).iter_messages()]
    raw = [unwrap(data) for topic, data in found if topic == "raw/plant/state"]
    assert raw == [*bad, short, codec.encode(state)]
    assert [topic for topic, _ in found].count("view/plant/state") == 1


@pytest.mark.parametrize(("rate", "views"), [(20, 40), (100, 200), (1000, 200)])
def test_a_fast_loop_has_all_its_bytes_in_the_log_and_100_views_a_second(
    tmp_path: Path, config: Config, rate: int, views: int
) -> None:
    path = tmp_path / "run.mcap"
    weights = m.OutputWeights(
        run_id="c", seq=0, hidden_version=0, hidden_sha256="", K=m.Array.of(np.zeros((3, PLANT.d)))
    )
    with LogWriter(path, config, PLANT) as writer:
        for i in range(2 * rate):
            state = m.PlantState(
                run_id="p", seq=i, t=i / rate, x=[0.0] * 4, applied=None, source="hold", command_seq=-1
            )
            writer.write("plant/state", codec.encode(state), i * 1_000_000_000 // rate)
            # Topics without such a limit are complete.
            writer.write("controller/output_weights", codec.encode(weights), i * 1_000_000_000 // rate)
    with path.open("rb") as stream:
        found = [channel.topic for _, channel, _ in make_reader(stream).iter_messages()]
    assert [found.count(name) for name in ("raw/plant/state", "view/plant/state")] == [2 * rate, views]
    assert found.count("view/controller/output_weights") == 2 * rate


def test_a_simulation_saves_the_same_log_twice(
    tmp_path: Path, config: Config, messages: list[Logged]
) -> None:
    run = gather(config, messages)
    save(run, tmp_path / "a.mcap")
    save(run, tmp_path / "b.mcap")
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()
    assert logged(tmp_path / "a.mcap") == payloads(messages)


# -- a full disk -----------------------------------------------------------------------------------------


def test_nothing_is_ever_overwritten(tmp_path: Path, config: Config) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(b"mine")
    with pytest.raises(LogExistsError, match="exists already"):
        LogWriter(path, config, PLANT, patient=True)
    assert path.read_bytes() == b"mine"


def test_an_unwritable_place_is_an_error_or_is_waited_for(tmp_path: Path, config: Config) -> None:
    (tmp_path / "file").write_bytes(b"")
    path = tmp_path / "file" / "run.mcap"
    with pytest.raises(LogError, match="cannot be created"):
        LogWriter(path, config, PLANT)
    writer = LogWriter(path, config, PLANT, patient=True)
    writer.write("plant/state", b"early", 1)
    assert not writer.flush()
    assert writer.sink.error is not None
    (tmp_path / "file").unlink()
    assert writer.flush()
    assert writer.sink.error is None
    writer.close()
    assert read_run(path).bad == {"plant/state: malformed": 1}


@contextmanager
def file_size_limit(limit: int) -> Iterator[None]:
    """Limit files of this process to `limit` bytes, which a writer sees as a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_after_a_full_disk_the_log_continues_where_it_stopped(
    tmp_path: Path, config: Config, messages: list[Logged]
) -> None:
    path = tmp_path / "run.mcap"
    writer = LogWriter(path, config, PLANT)
    third = len(messages) // 3
    limit = path.stat().st_size + 500
    with file_size_limit(limit):
        for topic, message, log_time in messages[: 2 * third]:
            writer.write(topic.name, codec.encode(message), log_time)
        assert not writer.flush()
        assert writer.sink.error is not None
        assert "cannot be written" in writer.sink.error
        assert path.stat().st_size == limit
        assert read_run(path).truncated
    for topic, message, log_time in messages[2 * third :]:
        writer.write(topic.name, codec.encode(message), log_time)
    assert writer.flush()
    writer.close()
    assert logged(path) == payloads(messages)
    assert not read_run(path).truncated


def test_a_disk_that_stays_full_costs_messages_not_memory(tmp_path: Path, config: Config) -> None:
    path = tmp_path / "run.mcap"
    noise = np.random.default_rng(0).bytes(10_000)
    writer = LogWriter(path, config, PLANT)
    writer.sink.limit = 200_000
    with file_size_limit(20_000):
        for i in range(100):
            writer.write("controller/keyframe", noise, i)
        writer.flush()
        assert writer.counters["messages"] < 40
        assert writer.counters["messages"] + writer.counters["dropped"] == 100
        with pytest.raises(LogError, match="tandem recover"):
            writer.close()
    assert read_run(path).truncated


def test_sink_keeps_its_place_in_a_torn_write(tmp_path: Path) -> None:
    sink = Sink(tmp_path / "file")
    data = [bytes([i]) * 1000 for i in range(5)]
    with file_size_limit(1500):
        for piece in data:
            sink.write(piece)
        assert not sink.flush()
        assert (sink.written, sink.pending, sink.tell()) == (1500, 3500, 5000)
    assert sink.close()
    assert (tmp_path / "file").read_bytes() == b"".join(data)
