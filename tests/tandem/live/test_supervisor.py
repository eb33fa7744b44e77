"""`tandem run` with its real processes: its files, the failures that it survives, and that no process remains."""

from __future__ import annotations

import os
import shlex
import signal
import socket
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from run_log.reading.reader import read_run
from run_log.replaying.replay import replay
from run_log.writing.parts import part_path
from tandem.live.files import claimed
from tandem.terminal import Refused
from tests.helpers.launched import PATIENCE_S, RUN, launched, small
from tests.helpers.live import free_endpoint, wait_for
from tests.helpers.paths import write_namesakes
from tests.helpers.plants.tanks import write_tanks

pytestmark = pytest.mark.live


def live() -> list[str]:
    """Return the arguments for a run with a live view in the browser."""
    pytest.importorskip("websockets", reason="pip install 'tandem-control[live]'")
    return ["--live", "--set", f"live.port={free_endpoint().rpartition(':')[2]}"]


def test_a_run_leaves_figures_log_and_picture_and_restarts_its_trainer(tmp_path: Path):
    (tmp_path / "run.mcap").write_text("an older run")

    def trainers() -> set[str]:
        infos = read_run(tmp_path / "run.mcap").run_infos
        return {info.run_id for info in infos if info.process == "trainer"}

    with launched(tmp_path, *small()) as run:
        run.hears("hidden weights 1 adopted")
        run.kill("trainer")
        run.hears("the trainer died (killed by SIGKILL); it restarts in 0.5 s")
        wait_for(lambda: len(trainers()) == 2, PATIENCE_S, every=0.2)
        run.signal(signal.SIGINT)
        code, result = run.ends()
    assert code == 0, run.said
    assert "error" not in result
    assert result["weights_adopted"] >= 1
    assert result["log"] == str(tmp_path / "run.mcap")
    log = read_run(tmp_path / "run.mcap")
    assert not log.truncated
    assert [tick.seq for tick in log.ticks] == list(range(result["ticks"]))
    assert {info.process for info in log.run_infos} >= {
        "router",
        "plant",
        "controller",
        "trainer",
        "recorder",
    }
    assert (tmp_path / "run.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "run.1.mcap").read_text() == "an older run"
    assert any("run.1.mcap" in text for text in run.said)


def test_ctrl_c_stops_cleanly_with_log_and_picture(tmp_path: Path):
    with socket.socket() as other:
        # A run starts even if the port of the live view is in use.
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        there = ("--live", "--set", f"live.port={port}")
        with launched(tmp_path, "--oracle", "linear", *there) as run:
            run.hears(f"no live view: live.port {port} is in use")
            run.hears("first command: the run begins")
            run.signal(signal.SIGINT)
            code, result = run.ends()
    assert code == 0, run.said
    assert result["ticks"] >= 1
    assert not read_run(tmp_path / "run.mcap").truncated
    assert (tmp_path / "run.png").exists()


@pytest.mark.parametrize("output", ["| head -n 3 > heard.txt", "> /dev/full 2> /dev/full"])
def test_a_closed_terminal_ends_the_display_and_not_the_loop(tmp_path: Path, output: str):
    log = tmp_path / "run.mcap"
    run = shlex.join([*RUN, "--seconds", "2", "--oracle", "linear", "--log", str(log)])
    command = f"{run} 2>&1 {output}; exit ${{PIPESTATUS[0]}}"
    done = subprocess.run(
        ["bash", "-c", command], cwd=tmp_path, capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )
    # The exit code reports a full disk, because the figures are lost. A closed pipe is not an error.
    assert done.returncode == (1 if "full" in output else 0), done.stderr
    assert done.stderr == ""
    ran = read_run(log)
    assert not ran.truncated
    assert len(ran.ticks) >= 40
    assert (tmp_path / "run.png").exists()


def test_only_a_plant_file_is_loaded_from_the_current_folder(tmp_path: Path):
    write_namesakes(tmp_path)
    file = write_tanks(tmp_path)
    with launched(tmp_path, *small(), "--set", "plant.model=tanks.py:TANKS") as run:
        # A run without a whole period has no figure between samples.
        run.hears(" ticks, ", times=2, after="first command: the run begins")
        run.signal(signal.SIGINT)
        code, result = run.ends()
    assert code == 0, run.said
    assert "error" not in result
    assert result["excess_between_samples"] == 0.0
    file.unlink()
    log = read_run(tmp_path / "run.mcap")
    assert log.plant is not None
    assert log.plant.name == "tanks"
    assert replay(log).equal


def test_ctrl_c_twice_ends_every_process(tmp_path: Path):
    with launched(tmp_path, "--oracle", "linear") as run:
        run.hears("first command: the run begins")
        for pid in run.pids():
            os.kill(pid, signal.SIGSTOP)
        run.signal(signal.SIGINT)
        time.sleep(0.5)  # sooner it would count as the same Ctrl-C
        run.signal(signal.SIGINT)
        code, result = run.ends()
    # After a first Ctrl-C it would have waited for them to stop, with another exit code.
    assert code == 130, run.said
    assert "tandem recover" in result["error"]


def test_a_killed_supervisor_leaves_nothing_running(tmp_path: Path):
    with launched(tmp_path, *small(), *live()) as run:
        run.hears("first command: the run begins")
        started = run.pids()
        assert len(started) == 6
        run.signal(signal.SIGKILL)
        wait_for(lambda: run.pids() == [], PATIENCE_S, every=0.05)
    assert read_run(tmp_path / "run.mcap").ticks


def test_a_dead_plant_ends_the_run_and_is_named(tmp_path: Path):
    with launched(tmp_path, "--oracle", "linear") as run:
        run.hears("first command: the run begins")
        run.kill("plant")
        code, result = run.ends()
    assert code == 1
    assert "the plant died (killed by SIGKILL)" in result["error"]
    assert result["ticks"] >= 1


def test_a_dead_recorder_or_live_view_is_reported_and_the_loop_continues(tmp_path: Path):
    loudly = "NOT LOGGED from here on: the recorder died (killed by SIGKILL); the loop continues"
    with launched(tmp_path, "--oracle", "linear", *live()) as run:
        run.hears("first command: the run begins")
        run.kill("live")
        run.hears("the live-view died (killed by SIGKILL); the run continues without it")
        run.kill("record")
        run.hears(" ticks, ", times=3, after=loudly)
        run.signal(signal.SIGINT)
        code, result = run.ends()
    begin = next(k for k, line in enumerate(run.said) if loudly in line)
    ticks = [
        int(line.partition(" ticks, ")[0].split()[-1]) for line in run.said[begin:] if " ticks, " in line
    ]
    assert ticks[-1] > ticks[0]
    assert code == 1
    assert "the recorder ended early" in result["error"]


def test_a_process_that_cannot_start_is_named_with_its_own_message(tmp_path: Path):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with launched(tmp_path, "--set", f'bus.endpoint="tcp/127.0.0.1:{port}"') as run:
            code, result = run.ends()
    assert code == 1
    assert "the router was not ready" in result["error"]
    assert f"127.0.0.1:{port} is in use" in result["error"]


def test_a_configuration_that_admits_no_controller_is_a_configuration_error(tmp_path: Path):
    arguments = ("--oracle", "linear", "--set", "controller.W=[20.0, 20.0, 20.0, 1000.0]")
    with launched(tmp_path, *arguments) as run:
        code, result = run.ends()
    assert code == 2, result
    assert "the controller was not ready" in result["error"]


def test_files_are_moved_aside_together_and_two_runs_do_not_meet(tmp_path: Path):
    log = tmp_path / "a.mcap"
    for name in ("a.mcap", "a.part2.mcap", "a.png", "a.1.png", "ab.part2.mcap"):
        (tmp_path / name).write_text(name)
    with claimed(log) as (files, moved):
        assert files.folder.is_dir()
        assert not log.exists()
        assert len(moved) == 3
        assert not (tmp_path / "a.part2.mcap").exists()
        assert (tmp_path / "a.2.part2.mcap").read_text() == "a.part2.mcap"
        assert (tmp_path / "ab.part2.mcap").exists()
        assert (tmp_path / "a.2.mcap").read_text() == "a.mcap"
        assert (tmp_path / "a.2.png").read_text() == "a.png"
        assert (tmp_path / "a.1.png").read_text() == "a.1.png"
        log.write_text("growing")
        with pytest.raises(Refused, match="another run is writing this log"), claimed(log):
            pass
        assert log.read_text() == "growing"
    with claimed(log) as (_, moved):
        assert len(moved) == 1


@pytest.mark.parametrize("name", ["a.png", "folder", "file/x.mcap"])
def test_places_where_no_log_can_be(tmp_path: Path, name: str):
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_text("")
    with pytest.raises(Refused, match=name.split("/")[0]), claimed(tmp_path / name):
        pass


@pytest.mark.parametrize(
    "name", ["mylog", "mylog.", ".mylog", "my.log", "my.1", os.fsdecode(b"caf\xe9.mcap")]
)
def test_any_name_of_a_log_is_moved_aside_again_and_again(tmp_path: Path, name: str):
    log = tmp_path / name
    contents = []
    for number in range(3):
        with claimed(log) as (files, moved):
            assert len(moved) == (3 if number else 0)
            for path in (files.log, files.picture, part_path(files.log, 2)):
                assert not path.exists()
                contents.append(f"{number} {path.name}".encode(errors="surrogateescape"))
                path.write_bytes(contents[-1])
    there = [path.read_bytes() for path in tmp_path.iterdir() if path.is_file()]
    assert sorted(there) == sorted(contents)
    assert len([path for path in tmp_path.iterdir() if path.is_dir()]) == 3


@pytest.mark.parametrize("taken", ["a.mcap", "a.png", "a.part2.mcap", "a.processes"])
@pytest.mark.parametrize("make", [os.mkfifo, lambda path: path.symlink_to("elsewhere")])
def test_a_pipe_or_a_link_with_the_name_of_a_runs_file_keeps_its_place(
    tmp_path: Path, taken: str, make: Callable[[Path], None]
):
    (tmp_path / "elsewhere").write_text("another file")
    if taken != "a.mcap":
        (tmp_path / "a.mcap").write_text("an older run")
    make(tmp_path / taken)
    before = sorted(tmp_path.iterdir())
    with (
        pytest.raises(Refused, match=f"{taken}: cannot be written: it is a (pipe|link)"),
        claimed(tmp_path / "a.mcap"),
    ):
        pass
    assert sorted(tmp_path.iterdir()) == before


def test_a_log_with_a_name_that_is_not_utf_8_is_written_and_drawn(tmp_path: Path):
    name = os.fsdecode(b"caf\xe9.mcap")
    linear = ("--seconds", "1", "--oracle", "linear")
    with launched(tmp_path, *linear, "--log", name) as run:
        code, result = run.ends()
    assert code == 0, run.said
    assert result["ticks"] > 0
    assert os.fsencode(result["log"]).endswith(b"caf\xe9.mcap")
    log = tmp_path / name
    assert log.with_suffix(".png").is_file()
    assert read_run(log).config.log.path.endswith("caf\\udce9.mcap")
