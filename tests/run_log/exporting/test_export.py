"""A log in the formats of other tools: each is read back by the tool's own reader and compared with the log."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import rerun as rr
from rerun.chunk import RrdReader

from lbmpc.plants import get_plant
from node_runtime.config.loading import override, to_json
from node_runtime.config.sections import Config
from protocol import codec, topics
from protocol import messages as m
from run_log.errors import LogError, LogExistsError
from run_log.exporting import tables
from run_log.exporting.export import Exported, export
from run_log.exporting.rerun_file import _plot
from run_log.file_format import READABLE
from run_log.reading.reader import read_run
from run_log.run import Run
from run_log.writing.parts import PartedLog, existing_parts
from run_log.writing.writer import LogWriter
from tandem.cli import main
from tests.run_log.samples import STEPS, Logged

Rows = list[dict[str, Any]]


def write_log(path: Path, config: Config, messages: list[Logged]) -> Path:
    """Record a run, and user messages, invalid messages and messages on an unknown key."""
    with LogWriter(path, config, get_plant("moore_greitzer"), versions={"python": "3.11"}) as writer:
        for i, (topic, message, log_time) in enumerate(messages):
            writer.write(topic.name, codec.encode(message), log_time)
            if i % 50 == 49:
                writer.flush()
            if topic is topics.PLANT_STATE:
                wind: dict[str, Any] = {"speed": 0.1 * message.seq, "from": "N", "ok": True}
                # The first rows do not have these fields.
                wind |= {"gust": {"speed, peak": 3}, "a.b": [1, 2.5]} if message.seq > 40 else {}
                writer.write("user/wind", json.dumps(wind).encode(), log_time)
        writer.write(topics.PLANT_STATE.name, b"no message", log_time)
        writer.write("plant/unheard_of", b"\x00", log_time)
    return path


@pytest.fixture(scope="module")
def log(config: Config, messages: list[Logged], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_log(tmp_path_factory.mktemp("log") / "run.mcap", config, messages)


@pytest.fixture(scope="module")
def out(log: Path) -> Path:
    return log.parent


@pytest.fixture(scope="module")
def exported(log: Path, out: Path) -> Exported:
    with pytest.MonkeyPatch.context() as patch:
        # Several batches of each table.
        patch.setattr(tables, "ROWS", 32)
        return export(log, csv=out / "csv", parquet=out / "parquet", rrd=out / "run.rrd")


@pytest.fixture(scope="module")
def run(log: Path) -> Run:
    return read_run(log)


def read_csv(folder: Path, table: str) -> Rows:
    with (folder / f"{table.replace('/', '.')}.csv").open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


def read_parquet(folder: Path, table: str) -> pa.Table:
    return pq.read_table(folder / f"{table.replace('/', '.')}.parquet")


# -- each format against the log -------------------------------------------------------------------------


def test_csv_has_every_message_of_the_log_with_names_units_and_bits(
    exported: Exported, out: Path, run: Run
) -> None:
    states = read_csv(out / "csv", "plant/state")
    entries = run.entries(topics.PLANT_STATE)
    assert len(states) == len(entries) == STEPS
    start = run.run_infos and run.entries(topics.RUN_INFO["controller"])[0].log_time
    for row, entry in zip(states, entries, strict=True):
        state = entry.message
        assert int(row["log_time [ns]"]) == entry.log_time
        assert float(row["since_start [s]"]) == (entry.log_time - start) / 1e9
        assert float(row["plant_time [s]"]) == state.t
        assert [float(row[f"x.{name}"]) for name in ("z [1]", "y [1]", "r [1]", "rdot [1/s]")] == state.x
        assert row["applied.u [1]"] == ("" if state.applied is None else repr(state.applied[0]))
        assert (row["source"], int(row["seq"])) == (state.source, state.seq)
    ticks = read_csv(out / "csv", "controller/tick")
    assert [row["late"] for row in ticks] == ["true" if tick.late else "false" for tick in run.ticks]
    assert [float(row["loop_time [s]"]) for row in ticks] == [tick.t for tick in run.ticks]
    commands = read_csv(out / "csv", "controller/command")
    assert [json.loads(row["plan.u [1]"]) for row in commands] == [
        [u for (u,) in one.plan] for one in run.commands
    ]
    about = json.loads((out / "csv" / "about.json").read_text(encoding="utf-8"))
    assert about["configuration"] == json.loads(to_json(run.config))
    assert about["versions"] == {"python": "3.11"}
    assert {name: table["rows"] for name, table in about["tables"].items()} == exported.tables
    kinds = {one["name"]: (one["kind"], one["unit"]) for one in about["tables"]["plant/state"]["columns"]}
    assert kinds["x.rdot"] == ("number", "1/s")
    assert kinds["seq"] == ("integer", "")


def test_parquet_keeps_types_nulls_and_units(exported: Exported, out: Path, run: Run) -> None:
    results = read_parquet(out / "parquet", "controller/result")
    assert results["iterations"].to_pylist() == [result.iterations for result in run.results]
    assert results["slack_row"].to_pylist() == [result.slack_row for result in run.results]
    h = [None if result.h is None else result.h[0] for result in run.results]
    assert results["h.z"].to_pylist() == h
    assert h[0] is None
    ticks = read_parquet(out / "parquet", "controller/tick")
    assert ticks["late"].to_pylist() == [tick.late for tick in run.ticks]
    times = [entry.log_time for entry in run.entries(topics.TICK)]
    assert ticks["log_time"].cast(pa.int64()).to_pylist() == times
    commands = read_parquet(out / "parquet", "controller/command")
    assert commands["plan.u"].to_pylist() == [[u for (u,) in one.plan] for one in run.commands]
    kinds = {
        "log_time": pa.timestamp("ns", tz="UTC"),
        "late": pa.bool_(),
        "slot": pa.int64(),
        "lateness": pa.float64(),
        "state_verdict": pa.string(),
    }
    assert {name: ticks.schema.field(name).type for name in kinds} == kinds
    assert ticks.schema.field("x.rdot").metadata == {b"unit": b"1/s"}
    about = ticks.schema.metadata
    assert json.loads(about[b"tandem.configuration"]) == json.loads(to_json(run.config))
    assert json.loads(about[b"tandem.versions"]) == {"python": "3.11"}
    assert about[b"tandem.table"] == b"controller/tick"


def test_rerun_has_series_events_and_a_layout(exported: Exported, out: Path, run: Run) -> None:
    found = series(out / "run.rrd")
    times, values = found["/plant/state/x/rdot"]
    assert values == [state.x[3] for state in run.plant_states]
    assert times == [entry.log_time for entry in run.entries(topics.PLANT_STATE)]
    times, values = found["/controller/result/h/z"]
    with_h = [entry for entry in run.entries(topics.RESULT) if entry.message.h is not None]
    assert values == [entry.message.h[0] for entry in with_h]
    assert times == [entry.log_time for entry in with_h]
    assert found["/controller/tick/late"][1] == [float(tick.late) for tick in run.ticks]
    assert set(found["/bounds/x_max/z"][1]) == {1.0}
    assert len(found["/targets/x/z"][1]) == len(run.results)
    # A text is written only when it changes.
    assert found["/controller/result/status"][1] == ["converged", "iteration limit", "converged"]
    assert "plant: the input comes from: command (before: hold)" in found["/events"][1]
    reader = RrdReader(out / "run.rrd")
    assert len(reader.blueprints()) == 1
    names = {
        chunk.entity_path: chunk.to_record_batch()["SeriesLines:names"].to_pylist()
        for chunk in reader.stream().to_chunks()
        if "SeriesLines:names" in chunk.to_record_batch().schema.names
    }
    assert names["/plant/state/x/rdot"] == [["x.rdot [1/s]"]]


def test_the_plots_of_rerun_name_the_series_as_they_are_written() -> None:
    plant = get_plant("moore_greitzer")
    (path,) = _plot(plant, "mass flow", ["plant/state/x"]).contents
    assert path == rr.new_entity_path(["plant", "state", "x", "mass flow"])


def series(path: Path) -> dict[str, tuple[list[int], list[Any]]]:
    """Return the times and values of the numbers or texts of each entity."""
    found: dict[str, tuple[list[int], list[Any]]] = {}
    for chunk in RrdReader(path).stream().to_chunks():
        rows = chunk.to_record_batch()
        for component in ("Scalars:scalars", "TextLog:text"):
            if component in rows.schema.names:
                times, values = found.setdefault(chunk.entity_path, ([], []))
                times += rows["log_time"].cast(pa.int64()).to_pylist()
                values += [one for (one,) in rows[component].to_pylist()]
    return found


def test_all_formats_hold_the_same(exported: Exported, out: Path) -> None:
    assert set(exported.tables) >= {"bounds", "targets", "events", "controller/health", "user/wind"}
    found = series(out / "run.rrd")
    for name, count in exported.tables.items():
        rows, table = read_csv(out / "csv", name), read_parquet(out / "parquet", name)
        assert len(rows) == len(table) == count
        for title, field in zip(rows[0], table.schema, strict=True):
            unit = (field.metadata or {}).get(b"unit", b"").decode()
            assert title == (f"{field.name} [{unit}]" if unit else field.name)
            read = json.loads if pa.types.is_list(field.type) else READ.get(field.type, str)
            there = [None if row[title] == "" else read(row[title]) for row in rows]
            column = table[field.name]
            values = (column.cast(pa.int64()) if field.name == "log_time" else column).to_pylist()
            assert there == [None if value == "" else value for value in values], (name, field.name)
            entity = "/" + "/".join([name, *field.name.split(".")]).replace(", ", "\\,\\ ")
            if field.type in NUMBERS and field.name != "since_start" and name != "events":
                assert found.get(entity, ([], []))[1] == [one for one in values if one is not None], entity


NUMBERS = (pa.float64(), pa.int64(), pa.bool_())
READ: dict[pa.DataType, Callable[[str], Any]] = {
    pa.float64(): float,
    pa.int64(): int,
    pa.bool_(): {"true": True, "false": False}.__getitem__,
    pa.timestamp("ns", tz="UTC"): int,
}


# -- what is in a log, and what is not -------------------------------------------------------------------


def test_fields_that_come_late_are_empty_before(exported: Exported, out: Path) -> None:
    rows = read_csv(out / "csv", "user/wind")
    assert [row["gust.speed, peak"] for row in rows] == [""] * 41 + ["3.0"] * (STEPS - 41)
    table = read_parquet(out / "parquet", "user/wind")
    assert table["a.b"].to_pylist() == [None] * 41 + [[1.0, 2.5]] * (STEPS - 41)
    assert table["speed"].to_pylist() == [0.1 * i for i in range(STEPS)]
    assert not list(out.rglob("*.old"))


def test_texts_with_carriage_returns_and_numbers_beyond_a_table_are_exported(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "run.mcap", Config(), get_plant("moore_greitzer")) as writer:
        for i in range(3):
            note = {"note": f"valve\ropened {i}", **({"late\r": 1} if i == 2 else {})}
            writer.write("user/note", json.dumps(note).encode(), i * 10**9)
        forged = m.Health(
            run_id="p-1", seq=0, process="plant", status="running", counters={"n": 2**64 - 1}, note=""
        )
        writer.write("plant/health", codec.encode(forged), 10**9)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tables, "ROWS", 1)
        done = export(tmp_path / "run.mcap", csv=tmp_path / "csv", parquet=tmp_path / "parquet")
    assert done.tables["user/note"] == 3
    rows = read_csv(tmp_path / "csv", "user/note")
    assert [row["note"] for row in rows] == [f"valve\nopened {i}" for i in range(3)]
    assert [row["late\n"] for row in rows] == ["", "", "1.0"]
    assert read_parquet(tmp_path / "parquet", "user/note")["note"].to_pylist()[0] == "valve\ropened 0"
    assert read_parquet(tmp_path / "parquet", "plant/health")["counters.n"].to_pylist() == [None]


def test_messages_without_a_row_are_counted(exported: Exported) -> None:
    assert exported.bad == {"plant/state: malformed": 1}
    assert exported.strangers == {"plant/unheard_of": 1}
    assert exported.damage == exported.notes == []


def test_a_fast_loop_is_exported_at_its_full_rate(messages: list[Logged], tmp_path: Path) -> None:
    start = messages[0][2]
    fast = [(topic, message, start + (log_time - start) // 50) for topic, message, log_time in messages]
    path = write_log(tmp_path / "fast.mcap", override(Config(), ["rate=1000"]), fast)
    found = export(path, csv=tmp_path / "csv")
    assert found.tables["plant/state"] == found.tables["controller/result"] == STEPS
    assert found.tables["user/wind"] == STEPS


@pytest.mark.parametrize("number", READABLE)
def test_logs_of_all_readable_formats_are_exported(
    number: int, config: Config, messages: list[Logged], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("run_log.writing.writer.LIBRARY", f"tandem log {number}; test")
    path = write_log(tmp_path / "run.mcap", config, messages[:100])
    assert export(path, csv=tmp_path / "csv").tables["bounds"] == 1


def test_a_log_in_parts_is_exported_as_one(
    config: Config, messages: list[Logged], log: Path, tmp_path: Path
) -> None:
    whole = export(log, csv=tmp_path / "whole")
    first = tmp_path / "run.mcap"
    settings = override(config, [f'log.path="{first}"', f"log.split_minutes={1 / 60}"])
    writer = PartedLog(settings, get_plant("moore_greitzer"), now=0.0, start_ns=messages[0][2])
    for i, (topic, message, log_time) in enumerate(messages):
        now = (log_time - messages[0][2]) * 1e-9
        writer.write(topic.name, codec.encode(message), log_time, now)
        if i % 50 == 49:
            writer.flush(now, log_time)
    writer.close()
    parts = existing_parts(first)
    assert len(parts) > 1
    found = export(first, csv=tmp_path / "parts")
    assert found.log == [str(part) for part in parts]
    assert found.notes == []
    assert found.tables == {name: rows for name, rows in whole.tables.items() if not name.startswith("user/")}
    for name in ("plant/state", "controller/result", "controller/run_info", "bounds"):
        assert read_csv(tmp_path / "parts", name) == read_csv(tmp_path / "whole", name)
    parts[1].unlink()
    assert "not in the same folder" in export(first, csv=tmp_path / "one").notes[0]


def test_a_cut_log_is_exported_up_to_the_cut(log: Path, tmp_path: Path) -> None:
    cut = tmp_path / "cut.mcap"
    data = log.read_bytes()
    cut.write_bytes(data[: len(data) * 2 // 3])
    found = export(cut, csv=tmp_path / "csv")
    assert 0 < found.tables["plant/state"] == len(read_run(cut).plant_states) < STEPS
    assert "was cut short at byte" in found.notes[0]


def test_a_damaged_log_exports_what_can_be_read_and_says_so(
    exported: Exported, log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    damaged = tmp_path / "damaged.mcap"
    data = bytearray(log.read_bytes())
    data[len(data) // 2] ^= 4
    damaged.write_bytes(data)
    assert main(["export", str(damaged), "--csv", str(tmp_path / "csv"), "--json"]) == 1
    found = json.loads(capsys.readouterr().out)
    assert STEPS // 2 < found["tables"]["plant/state"]
    assert sum(found["tables"].values()) < sum(exported.tables.values())
    assert "damaged at byte" in found["damage"][0]
    assert len(read_csv(tmp_path / "csv", "plant/state")) == found["tables"]["plant/state"]


def test_the_command_writes_and_refuses_in_words(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    said: Callable[..., tuple[int, str, str]] = partial(command, capsys, str(log))
    assert said("--csv", str(tmp_path / "csv"), "--json")[0] == 0
    assert said()[::2] == (2, "tandem: name what to write: --csv FOLDER, --parquet FOLDER or --rrd FILE\n")
    code, _, error = said("--csv", str(tmp_path / "csv"))
    assert (code, "is not empty" in error) == (2, True)
    code, _, error = said("--rrd", str(log))
    assert (code, "exists already" in error) == (2, True)
    code, _, error = said("--parquet", str(log))
    assert (code, "cannot be used as a folder" in error) == (2, True)
    with pytest.raises(LogExistsError):
        export(log, rrd=log)
    with pytest.raises(LogError, match="cannot be written"):
        export(log, rrd=tmp_path / "nowhere" / "run.rrd")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
def test_a_full_disk_is_an_error(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("run_log.exporting.export._new_file", lambda path: Path("/dev/full"))
    code, _, error = command(capsys, str(log), "--rrd", str(tmp_path / "run.rrd"))
    assert (code, "/dev/full: cannot be written" in error, "No space left" in error) == (2, True, True)


def command(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, str, str]:
    code = main(["export", *words])
    said = capsys.readouterr()
    return code, said.out, said.err
