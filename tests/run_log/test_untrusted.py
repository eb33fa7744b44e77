"""A log from an unknown source runs no code, overwrites no file and uses bounded memory (docs/how/security.md)."""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
from pathlib import Path

import msgspec
import pytest
import zstandard
from mcap.opcode import Opcode
from mcap.writer import CompressionType, Writer

from lbmpc.plants import get_plant
from node_runtime.config.loading import from_json, override, to_json
from node_runtime.config.sections import Config
from node_runtime.config.strict import ConfigError
from protocol import codec, topics
from run_log import plant_record
from run_log.errors import LogError
from run_log.file_format import CONFIG, LIBRARY, PLANT, PROFILE
from run_log.reading import mcap_scan
from run_log.reading.gaps import lost_ticks
from run_log.reading.reader import read_run
from run_log.reading.recover import recover
from run_log.replaying.replay import replay
from run_log.reporting.report import report
from run_log.reporting.summary import summarise
from run_log.run import gather
from run_log.writing.writer import LogWriter
from tests.helpers.paths import ROOT
from tests.run_log.samples import synthetic, write

MEMORY = 3 * 1024**3
"""Address space in bytes within which a command must refuse a log with a message."""
FAR = 2**63 - 1
SMALL = override(
    Config(), ["controller.oracle=linear", "controller.horizon=8", "controller.solver.compile=never"]
)


def inside(number: int) -> bytes:
    return number.to_bytes(8, "little")


def bomb(path: Path, size: int, compression: str = "zstd") -> Path:
    """A log of a few kilobytes whose last chunk unpacks to `size` bytes."""
    with LogWriter(path, SMALL, get_plant("moore_greitzer")) as writer:
        writer.write("controller/tick", b"", 1)
    whole = path.read_bytes()
    packer = zstandard.ZstdCompressor(level=1).compressobj(size=size)
    block = bytes(2**20)
    data = b"".join(
        [packer.compress(block[: min(len(block), size - at)]) for at in range(0, size, len(block))]
    )
    data += packer.flush()
    name = compression.encode()
    chunk = inside(0) + inside(0) + inside(size) + bytes(4) + len(name).to_bytes(4, "little") + name
    chunk += inside(len(data)) + data
    end = whole.rindex(bytes([Opcode.DATA_END]) + inside(4))
    path.write_bytes(whole[:end] + bytes([Opcode.CHUNK]) + inside(len(chunk)) + chunk)
    return path


def test_a_small_log_that_unpacks_to_gigabytes_is_refused_before_it_is_unpacked(tmp_path: Path) -> None:
    path = bomb(tmp_path / "bomb.mcap", 3 * 1024**3)
    assert path.stat().st_size < 2**20
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for read in (lambda: read_run(path), lambda: recover(path, tmp_path / "whole.mcap")):
        with pytest.raises(LogError, match=r"unpack to more than .* not read"):
            read()
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 300 * 1024
    assert list(tmp_path.iterdir()) == [path]


def test_many_chunks_count_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config, messages = synthetic(override(Config(), ["log.chunk_bytes=8192"]), 60)
    path = write(tmp_path / "run.mcap", config, messages)
    read_run(path)
    monkeypatch.setattr(mcap_scan, "UNPACKED_TIMES", 1)
    monkeypatch.setattr(mcap_scan, "UNPACKED_ALWAYS", 0)
    with pytest.raises(LogError, match="unpack to more than"):
        read_run(path)


def test_another_compression_than_ours_is_damage(tmp_path: Path) -> None:
    path = bomb(tmp_path / "run.mcap", 1000, "lz4")
    with pytest.raises(LogError, match="its compression 'lz4' is not used in logs of Tandem"):
        read_run(path)


def far_log(path: Path) -> Path:
    """Write a log with a tick, a result and a command with the largest possible numbers."""
    config, messages = synthetic(override(Config(), ["controller.keyframe_every=20"]), 60)
    with LogWriter(path, config, get_plant(config.plant.model)) as writer:
        for topic, message, log_time in messages:
            far = topic in (topics.TICK, topics.RESULT, topics.COMMAND) and message.seq == 59
            one = msgspec.structs.replace(message, seq=FAR) if far else message
            writer.write(topic.name, codec.encode(one), log_time)
    return path


def test_a_distant_number_uses_no_memory_for_the_numbers_between(tmp_path: Path) -> None:
    run = read_run(far_log(tmp_path / "far.mcap"))
    assert (run.controllers[0], 59, FAR - 59) in lost_ticks(run)
    assert summarise(run).lost_ticks >= FAR - 59
    assert report(run, tmp_path)


def configured(path: Path, **changes: dict[str, object]) -> Path:
    """Write a log with a complete header and this configuration, and nothing else."""
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start(profile=PROFILE, library=LIBRARY)
        writer.add_attachment(0, 0, CONFIG, "application/json", json.dumps(changes).encode())
        writer.add_attachment(0, 0, "../../escaped", "text/plain", b"escaped")
        writer.finish()
    return path


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (
            {"l2nw": {"window": 2 * 10**9}},
            "l2nw.window = 2000000000 is not an integer of at least 1 and at most",
        ),
        ({"adaptation": {"refit": {"window": 10**12}}}, "adaptation.refit.window"),
        ({"network": {"window": 10**9}}, "network.window"),
        ({"network": {"hidden": [10**9]}}, "network.hidden"),
        ({"network": {"architecture": "os"}}, "no architecture is called"),
    ],
)
def test_sizes_and_names_in_a_logs_configuration_have_limits(
    changes: dict[str, dict[str, object]], said: str, tmp_path: Path
) -> None:
    with pytest.raises(LogError) as caught:
        read_run(configured(tmp_path / "run.mcap", **changes))
    assert said in str(caught.value)


def with_plant(path: Path, data: bytes) -> Path:
    """Write a log with this attachment and a configuration, and nothing else."""
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start(profile=PROFILE, library=LIBRARY)
        writer.add_attachment(0, 0, CONFIG, "application/json", b"{}")
        writer.add_attachment(0, 0, PLANT, "application/json", data)
        writer.finish()
    return path


def hostile(**changes: object) -> bytes:
    """Return the plant record of a log with these fields changed."""
    tree = json.loads(plant_record.encode(get_plant("moore_greitzer"), {}))
    tree["known"] |= changes
    return json.dumps(tree).encode()


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"{}", "missing required field `known`"),
        (b"not JSON", "JSON is malformed"),
        (b'{"known": {"A": ' + b"[" * 100_000 + b"]" * 100_000 + b'}, "files": {}}', "recursion"),
        (b'{"known": {}, "files": {}}', "missing required field"),
        (b" " * 1_000_001, "1000001 bytes, and 1000000 is the most"),
        (hostile(A=[[float("nan")] * 4] * 4), "malformed"),
        (hostile(A=[[1e999] * 4] * 4), "malformed"),
        (hostile(A=[[0.0] * 3] * 4), "A "),
        (hostile(x_min=["-inf"] * 5), "x_min"),
        (hostile(W=[-1.0] * 4), "W of z is -1"),
        (hostile(states=["z"] * 4), "are called 'z'"),
        (hostile(rhs="import os"), "unknown field"),
    ],
)
def test_a_hostile_plant_in_a_log_is_refused_by_name(data: bytes, said: str, tmp_path: Path) -> None:
    with pytest.raises(LogError) as caught:
        read_run(with_plant(tmp_path / "run.mcap", data))
    assert f"{PLANT}: " in str(caught.value)
    assert said in str(caught.value)


def test_a_deeply_nested_configuration_of_a_log_is_refused_or_read() -> None:
    with pytest.raises(ConfigError, match="recursion"):
        from_json('{"plant": ' + "[" * 100_000 + "]" * 100_000 + "}")


def test_a_log_that_names_code_without_its_plant_loads_no_code(tmp_path: Path) -> None:
    mark = tmp_path / "loaded"
    (tmp_path / "evil.py").write_text(f"open({str(mark)!r}, 'w')\nPLANT = 1\n")
    config = override(
        Config(), [f"plant.model={tmp_path}/evil.py:PLANT", f"plant.truth={tmp_path}/evil.py:PLANT"]
    )
    messages = synthetic(Config(), 20)[1]
    run = gather(config, messages, tmp_path / "run.mcap")
    for read in (summarise, lambda run: report(run, tmp_path)):
        with pytest.raises(LogError, match="Tandem loads no file because a log names it"):
            read(run)
    # The log also contains the controller's run info.
    told = [
        (
            topic,
            msgspec.structs.replace(message, config=to_json(config))
            if topic == topics.RUN_INFO["controller"]
            else message,
            at,
        )
        for topic, message, at in messages
    ]
    run = gather(Config(), told, tmp_path / "run.mcap")
    with pytest.raises(LogError, match="Tandem loads no file because a log names it"):
        replay(run)
    assert not mark.exists()


def test_a_network_that_no_message_could_carry_is_not_built(tmp_path: Path) -> None:
    config, messages = synthetic(override(SMALL, ["controller.oracle=dnn", "network.hidden=[4096, 4096]"]), 3)
    run = read_run(write(tmp_path / "run.mcap", config, messages))
    run.streams.pop(topics.RUN_INFO["controller"].name)
    with pytest.raises(LogError, match="hidden weights; at most 4194304 fit"):
        replay(run)


@pytest.fixture(scope="module")
def bombed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log that unpacks to more than a command's memory."""
    return bomb(tmp_path_factory.mktemp("bomb") / "bomb.mcap", 8 * 1024**3)


@pytest.mark.parametrize("command", ["replay", "report", "recover"])
def test_a_hostile_log_writes_no_file_and_runs_no_code(command: str, tmp_path: Path, bombed: Path) -> None:
    """The command has little memory, and its folder contains the files that the log names."""
    folder = tmp_path / "a" / "b"
    folder.mkdir(parents=True)
    (folder / "os.py").write_text("raise SystemExit('imported')")
    (tmp_path / "escaped").write_text("mine")
    os.link(bombed, folder / "bomb.mcap")
    configured(folder / "names.mcap", plant={"model": "../../os"}, network={"architecture": "os"})
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    code = (
        "import sys, resource; from tandem.cli import main;"
        f"resource.setrlimit(resource.RLIMIT_AS, ({MEMORY}, {MEMORY}));"
        f"print([main(['{command}', name]) for name in ('bomb.mcap', 'names.mcap')])"
    )
    run = subprocess.run(
        [sys.executable, "-P", "-c", code],
        capture_output=True,
        text=True,
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"},
        timeout=120,
    )
    expected = [2, 0] if command == "recover" else [2, 2]  # a complete file needs no recovery
    assert (run.returncode, run.stdout.splitlines()[-1]) == (0, str(expected)), run.stderr
    assert "Traceback" not in run.stderr
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before
