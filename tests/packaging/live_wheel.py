"""The wheel in bare environments, used from an empty folder. `make wheel-test` takes some minutes, mostly in pip."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from tests.helpers.live import free_endpoint
from tests.helpers.plants.tanks import write_tanks
from tests.packaging.wheel import build_wheel, copy_sources

PATIENCE_S = 600.0
"""Limit in seconds that only ends a hang."""


class Environment:
    """A virtual environment with the wheel and some of its extras. Commands run in a separate folder."""

    def __init__(self, wheel: Path, folder: Path, extras: str = ""):
        subprocess.run([sys.executable, "-m", "venv", str(folder)], check=True)
        self._bin = folder / "bin"
        what = f"{wheel}[{extras}]" if extras else str(wheel)
        subprocess.run([str(self._bin / "python"), "-I", "-m", "pip", "install", "--quiet", what], check=True)

    def tandem(self, cwd: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            self.command(*arguments),
            **{"cwd": cwd, "env": BARE, "capture_output": True, "text": True},
            timeout=PATIENCE_S,
            check=False,
        )

    def command(self, *arguments: str) -> list[str]:
        return [str(self._bin / "tandem"), *arguments]

    @contextmanager
    def running(self, cwd: Path, *arguments: str) -> Iterator[None]:
        """Run a command during the block; it must not end before."""
        process = subprocess.Popen(self.command(*arguments), cwd=cwd, env=BARE)
        try:
            yield
            assert process.poll() is None
        finally:
            process.terminate()
            process.wait(PATIENCE_S)


BARE = {"PATH": "/usr/bin:/bin"}
"""Return the environment without PYTHONPATH, so that only installed packages are found."""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    (folder / "sources").mkdir()
    return build_wheel(copy_sources(folder / "sources"), folder / "built")


@pytest.fixture(scope="module")
def whole(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Environment:
    return Environment(wheel, tmp_path_factory.mktemp("whole"), "trainer,log,live,export,experiment,cluster")


@pytest.fixture(scope="module")
def bare(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Environment:
    return Environment(wheel, tmp_path_factory.mktemp("bare"))


@pytest.mark.parametrize(
    ("command", "leaves"),
    [
        ("--version", ""),
        ("config show", ""),
        ("run --seconds 5", "run.mcap"),
        ("run --seconds 5 --set controller.tightening=invariant", "run.png"),
        ("run --seconds 5 --live", "run.mcap"),
        ("simulate --steps 20 --log simulated.mcap", "simulated.mcap"),
        ("experiment list", ""),
        ("experiment paper --quick --out paper --only lemma", "paper/report.html"),
    ],
)
def test_with_all_extras_every_command_works(whole: Environment, command: str, leaves: str, tmp_path: Path):
    done = whole.tandem(tmp_path, *command.split())
    assert done.returncode == 0, done.stderr
    assert (tmp_path / leaves).exists()


def test_a_users_plant_in_an_empty_folder(whole: Environment, tmp_path: Path):
    file = write_tanks(tmp_path)
    mine = ("--set", "plant.model=tanks.py:TANKS", "--set", "rate=20", "--set", "controller.horizon=20")
    sets = ("sets", "compute", "--kind", "box", "--set", "plant.model=tanks.py:TANKS", "--set", "rate=1")
    exports = [("export", "run.mcap", f"--{kind}", f"run.{kind}") for kind in ("csv", "parquet", "rrd")]
    for command in (("run", *mine, "--seconds", "5"), ("replay", "run.mcap"), *exports, sets):
        done = whole.tandem(tmp_path, *command)
        assert done.returncode == 0, done.stderr
    shown = whole.tandem(tmp_path, "config", "show", *mine)
    (tmp_path / "shown.toml").write_text(shown.stdout)
    again = whole.tandem(tmp_path, "config", "show", "--config", "shown.toml")
    assert again.stdout == shown.stdout
    # The log is sufficient; the file that it names is not loaded.
    file.write_text("raise SystemExit('loaded')\n")
    for command in ("replay", "report"):
        done = whole.tandem(tmp_path, command, "run.mcap")
        assert done.returncode == 0, done.stderr


def test_without_extras_router_plant_and_controller_run(bare: Environment, tmp_path: Path):
    here = ("--set", f'bus.endpoint="{free_endpoint()}"')
    with ExitStack() as started:
        for process in ("router", "plant", "controller"):
            started.enter_context(bare.running(tmp_path, process, *here))
        for process in ("router", "plant", "controller"):
            done = bare.tandem(tmp_path, "health", process, "--seconds", "120", *here)
            while ": starting" in done.stdout:
                done = bare.tandem(tmp_path, "health", process, "--seconds", "120", *here)
            assert done.returncode == 0, done.stdout


@pytest.mark.parametrize(
    ("command", "extras"),
    [
        ("run", "trainer,log"),
        ("simulate", "trainer,log"),
        ("trainer", "trainer"),
        ("record", "log"),
        ("live", "live"),
        ("replay x.mcap", "log"),
        ("report x.mcap", "log"),
        ("recover x.mcap", "log"),
        ("experiment paper --out paper", "experiment"),
    ],
)
def test_without_extras_the_other_commands_name_the_missing_one(
    bare: Environment, command: str, extras: str, tmp_path: Path
):
    done = bare.tandem(tmp_path, *command.split())
    assert done.returncode == 2, done.stderr
    assert done.stderr.startswith("tandem: this command needs ")
    assert f"pip install 'tandem-control[{extras}]'" in done.stderr
    assert list(tmp_path.iterdir()) == []
