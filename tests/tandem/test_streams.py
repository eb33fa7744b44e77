"""Commands with a closed or blocked output end without a traceback, and their exit code is right."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

TANDEM = f"'{sys.executable}' -m tandem"
LOST = "tandem: standard output cannot be written: No space left on device"


def shell(command: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["bash", "-c", f"set -o pipefail; {command}"],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        env={**os.environ, **environment},
    )


@pytest.mark.parametrize("command", ["config show", "--help", "experiment list", "config show --json"])
def test_a_reader_may_close_the_pipe(command: str) -> None:
    done = shell(f"{TANDEM} {command} | true")
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize(
    "command", ["config show", "--help", "--version", "simulate --steps 3 --oracle linear --json"]
)
def test_a_failed_write_is_reported_and_counted(command: str) -> None:
    done = shell(f"{TANDEM} {command} > /dev/full")
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1] == LOST
    assert "Traceback" not in done.stderr


def test_a_mistake_keeps_its_own_exit_code_when_nothing_can_be_written() -> None:
    assert shell(f"{TANDEM} config show --set zzz=1 > /dev/full 2> /dev/full").returncode == 2


@pytest.mark.long
def test_closed_streams_do_not_become_the_log(tmp_path: Path) -> None:
    log = tmp_path / "sim.mcap"
    made = shell(f"{TANDEM} simulate --steps 3 --oracle linear --log '{log}' >&- 2>&- <&-")
    assert made.returncode == 0
    assert shell(f"{TANDEM} replay '{log}'").returncode == 0


@pytest.mark.long
def test_a_terminal_that_is_not_utf8_still_shows_the_figures(tmp_path: Path) -> None:
    log = tmp_path / "試験.mcap"
    made = shell(
        f"{TANDEM} simulate --steps 3 --oracle linear --log '{log}' --json", PYTHONIOENCODING="latin-1"
    )
    assert made.returncode == 0, made.stderr
    assert json.loads(made.stdout)["log"] == str(log)
    told = shell(f"{TANDEM} report '{log}'", PYTHONIOENCODING="ascii")
    assert told.returncode == 0, told.stderr
    assert rf"picture {tmp_path}/\u8a66\u9a13.png" in told.stdout
    assert (tmp_path / "試験.png").exists()


def test_a_pipe_that_another_program_made_nonblocking_loses_nothing() -> None:
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    program = (
        "import sys; from tandem.streams import never_failing\n"
        "with never_failing() as output:\n"
        "    sys.stdout.write('x' * 1_000_000)\n"
        "    sys.exit(output.exit_code(0))"
    )
    with subprocess.Popen([sys.executable, "-c", program], stdout=writing) as started:
        os.close(writing)
        with open(reading, "rb") as pipe:
            assert len(pipe.read()) == 1_000_000
    assert started.returncode == 0
