"""The command line for people and programs: exit codes, one JSON object, one message."""

from __future__ import annotations

import json
import subprocess
import tomllib
from importlib import metadata
from pathlib import Path

import pytest

from lbmpc.plants import PLANTS
from node_runtime.config.loading import to_tree
from node_runtime.config.plant import spelt_out
from node_runtime.config.sections import Config
from tandem.cli import main
from tests.helpers.interpreter import imported, python

COMMANDS = (
    *("run", "simulate", "replay", "report", "recover", "router", "controller", "trainer", "plant", "record"),
    "health",
    "config show",
    "architecture check",
    *("model check", "model new", "identify"),
    *("sets compute", "sets check", "sets plot"),
)
KEYS = {
    *(
        "ticks",
        "late_ticks",
        "lost_ticks",
        "weights_adopted",
        "weights_refused",
        "weights_rolled_back",
        "iteration_limit_ticks",
        "fallback_ticks",
        "soft_ticks",
        "unreached_ticks",
        "target_distance",
    ),
    *(
        "episodes",
        "constraint_violations",
        "violated_rows",
        "excess_between_samples",
        "J",
        "deviation",
        "overshoot",
        "settled_s",
        "settled_by_state_s",
        "offset",
        "solve_ms",
        "tick_ms",
        "prediction_error",
        "weight",
        "constant_weight",
        "noise",
        "sensor_faults",
        "outside_ticks",
        "smallest_set_margin",
    ),
    "log",
}
HEAVY = {"torch", "casadi", "matplotlib", "zenoh", "numpy", "mcap"}


def tandem(*arguments: str, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    return python("-m", "tandem", *arguments, cwd=cwd)


def called(*arguments: str) -> int:
    """Return the exit code of the command in this process, which is quicker."""
    try:
        return main(arguments)
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else 1


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, subprocess.CompletedProcess[str]]:
    """A short simulation with its log, run once."""
    log = tmp_path_factory.mktemp("simulated") / "sim.mcap"
    return log, tandem("simulate", "--steps", "12", "--oracle", "linear", "--json", "--log", str(log))


def test_help_lists_every_command():
    shown = tandem("--help")
    assert shown.returncode == 0
    for command in COMMANDS:
        assert command.split()[0] in shown.stdout


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_explains_itself(command: str, capsys: pytest.CaptureFixture[str]):
    assert called(*command.split(), "--help") == 0
    assert "--json" in capsys.readouterr().out


def test_help_loads_nothing_heavy():
    code = """
from tandem.cli import main
try:
    main(["run", "--help"])
except SystemExit:
    pass
"""
    assert not imported(code) & HEAVY


@pytest.mark.parametrize(
    "arguments", [[], ["config"], ["fly"], ["run", "--secnds", "3"], ["run", "--oracle", "dn"]]
)
def test_a_mistake_in_the_arguments(arguments: list[str], capsys: pytest.CaptureFixture[str]):
    assert called(*arguments) == 2
    shown = capsys.readouterr()
    assert shown.out == ""
    assert shown.err != ""


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (
            ["config", "show", "--set", "controller.oracle=dn"],
            "is not one of constant, dnn, l2nw, linear, perfect; did you mean 'dnn'?",
        ),
        (["config", "show", "--set", "plant.model=compresor"], "did you mean 'moore_greitzer'?"),
        (["config", "show", "--config", "none.toml"], "none.toml: cannot be read"),
        (["controller", "--set", "plant.model=x"], "no plant is called 'x'"),
        (["plant", "--set", "plant.x0=[1.0]"], "plant.x0 has 1 entries"),
        (["run", "--rate", "-1"], "--rate: rate = -1.0 is not a number above 0"),
        (["run", "--seconds", "0"], "--seconds 0"),
        (["run", "--set", "trainer.batch=0"], "trainer.batch = 0 is not an integer of at least 1"),
        (["simulate", "--seed", "-3"], "--seed: seed = -3 is not an integer of at least 0"),
        (["simulate", "--x0", "1", "2"], "plant.x0 has 2 entries"),
        (["simulate", "--steps", "0"], "--steps 0: at least 1"),
        (["replay", "none.mcap"], "none.mcap: cannot be read"),
        (["report", "none.mcap"], "none.mcap: cannot be read"),
        (["recover", "none.mcap"], "none.mcap: cannot be read"),
    ],
)
def test_an_impossible_request_is_reported_once(
    arguments: list[str],
    expected: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    monkeypatch.chdir(tmp_path)
    assert called(*arguments, "--json") == 2
    shown = capsys.readouterr()
    assert expected in shown.err
    assert shown.err.count("tandem: ") == 1
    assert expected in json.loads(shown.out)["error"]
    assert list(tmp_path.iterdir()) == []


def test_a_wrong_length_in_a_file_names_the_file(tmp_path: Path):
    file = tmp_path / "mine.toml"
    file.write_text("[controller]\nQ = [1.0]\n")
    shown = tandem("config", "show", "--config", str(file))
    assert shown.returncode == 2
    assert f"{file}: controller.Q has 1 entries" in shown.stderr


def test_config_show_resolves_file_then_set(tmp_path: Path):
    file = tmp_path / "mine.toml"
    file.write_text("rate = 50.0\n[trainer]\nbatch = 7\nsteps = 8\n")
    arguments = ["config", "show", "--config", str(file), "--set", "trainer.batch=9"]
    as_toml = tomllib.loads(tandem(*arguments).stdout)
    as_json = json.loads(tandem(*arguments, "--json").stdout)
    expected = to_tree(spelt_out(Config(), PLANTS["moore_greitzer"]))
    assert expected["controller"]["W"] is not None
    expected["rate"] = 50.0
    expected["trainer"] |= {"batch": 9, "steps": 8}
    assert as_json == expected
    assert as_toml["trainer"] == expected["trainer"]


def test_simulate_prints_one_object(simulated: tuple[Path, subprocess.CompletedProcess[str]]):
    log, shown = simulated
    assert shown.returncode == 0, shown.stderr
    result = json.loads(shown.stdout)
    assert set(result) == KEYS
    assert result["ticks"] == 12
    assert set(result["solve_ms"]) == set(result["tick_ms"]) == {"p50", "p99", "max"}
    assert set(result["prediction_error"]) == {"first_second", "last_second"}
    assert result["log"] == str(log)
    assert "ticks" in shown.stderr


def test_a_log_is_never_overwritten(simulated: tuple[Path, subprocess.CompletedProcess[str]]):
    log, _ = simulated
    before = log.read_bytes()
    shown = tandem("simulate", "--steps", "2", "--log", str(log))
    assert shown.returncode == 2
    assert "exists already" in shown.stderr
    assert log.read_bytes() == before


def test_replay_of_a_simulated_log(simulated: tuple[Path, subprocess.CompletedProcess[str]]):
    log, _ = simulated
    shown = tandem("replay", str(log), "--json")
    assert shown.returncode == 0, shown.stderr
    result = json.loads(shown.stdout)
    assert (result["ticks"], result["equal"], result["first_difference"]) == (12, True, None)


def test_replay_with_a_changed_tolerance_differs(simulated: tuple[Path, subprocess.CompletedProcess[str]]):
    log, _ = simulated
    shown = tandem("replay", str(log), "--json", "--set", "controller.R=[2.0]")
    assert shown.returncode == 1, shown.stderr
    first = json.loads(shown.stdout)["first_difference"]
    assert {"tick", "field", "recorded", "replayed"} <= set(first)


def test_replay_refuses_a_tick_that_is_not_there(simulated: tuple[Path, subprocess.CompletedProcess[str]]):
    log, _ = simulated
    shown = tandem("replay", str(log), "--from-tick", "99")
    assert shown.returncode == 2
    assert "no tick 99" in shown.stderr


def test_report_draws_into_the_given_folder(
    simulated: tuple[Path, subprocess.CompletedProcess[str]], tmp_path: Path
):
    log, _ = simulated
    shown = tandem("report", str(log), "--output", str(tmp_path), "--json")
    assert shown.returncode == 0, shown.stderr
    result = json.loads(shown.stdout)
    assert set(result) >= KEYS
    assert result["pictures"]
    for picture in result["pictures"]:
        assert Path(picture).read_bytes().startswith(b"\x89PNG")
        assert Path(picture).parent == tmp_path


def test_a_file_that_is_no_log(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    file = tmp_path / "x.mcap"
    file.write_text("hello")
    for command in ("replay", "report", "recover"):
        assert called(command, str(file)) == 2
        assert "x.mcap" in capsys.readouterr().err


def test_recover_makes_a_cut_log_whole(
    simulated: tuple[Path, subprocess.CompletedProcess[str]], tmp_path: Path
):
    log, _ = simulated
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(log.read_bytes()[:-200])
    shown = tandem("recover", str(cut), "--json")
    assert shown.returncode == 0, shown.stderr
    assert json.loads(shown.stdout)["log"] == str(tmp_path / "cut.recovered.mcap")
    assert tandem("recover", str(cut)).returncode == 2  # it exists now, and no file is overwritten


def test_the_version_is_the_packages(capsys: pytest.CaptureFixture[str]):
    assert called("--version") == 0
    assert capsys.readouterr().out == f"tandem {metadata.version('tandem-control')}\n"


WITHOUT = """
import sys
from importlib.machinery import PathFinder

class Absent(PathFinder):
    @classmethod
    def find_spec(cls, name, path=None, target=None):
        if name.partition(".")[0] == sys.argv[1]:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Absent)
from tandem.cli import main
sys.exit(main(sys.argv[2:]))
"""
"""Run a command as if one package were not installed."""


@pytest.mark.parametrize(
    ("package", "command", "extras"),
    [
        ("torch", "run --seconds 1", "trainer,log"),
        ("torch", "trainer", "trainer"),
        ("torch", "simulate --steps 2", "trainer,log"),
        ("mcap", "run --seconds 1", "trainer,log"),
        ("mcap", "record --log x.mcap", "log"),
        ("mcap", "simulate --steps 2", "trainer,log"),
        ("mcap", "replay x.mcap", "log"),
        ("mcap", "recover x.mcap", "log"),
        ("zstandard", "run --seconds 1", "trainer,log"),
        ("zstandard", "simulate --steps 2 --log x.mcap", "trainer,log"),
        ("zstandard", "record --log x.mcap", "log"),
        ("zstandard", "replay x.mcap", "log"),
        ("matplotlib", "run --seconds 1", "trainer,log"),
        ("matplotlib", "report x.mcap", "log"),
        ("matplotlib", "sets plot x.json", "log"),
        ("matplotlib", "experiment list", "experiment"),
        ("jinja2", "experiment paper --out paper", "experiment"),
    ],
)
def test_a_package_that_is_missing_names_the_extra(package: str, command: str, extras: str, tmp_path: Path):
    shown = python("-c", WITHOUT, package, *command.split(), cwd=tmp_path)
    assert shown.returncode == 2, shown.stderr
    assert shown.stderr.count("tandem: ") == 1
    assert shown.stderr.endswith(f"this command needs {package}: pip install 'tandem-control[{extras}]'\n")
    assert list(tmp_path.iterdir()) == []


def test_without_extras_a_linear_run_needs_no_torch(tmp_path: Path):
    linear = ("simulate", "--steps", "2", "--oracle", "linear")
    shown = python("-c", WITHOUT, "torch", *linear, cwd=tmp_path)
    assert shown.returncode == 0, shown.stderr
