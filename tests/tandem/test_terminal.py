"""Foreign strings in the output of commands, and messages about limits."""

from __future__ import annotations

import json
import logging
import math
import os
import tomllib
from contextlib import suppress
from pathlib import Path

import pytest
from rich.console import RenderableType
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from lbmpc.plants import get_plant
from node_runtime.bus.mailbox import Delivery
from node_runtime.config.loading import load
from node_runtime.config.sections import Config
from protocol import codec, topics
from protocol import messages as m
from run_log.reading.reader import read_run
from run_log.writing.save import save
from tandem import terminal
from tandem.cli import main
from tandem.commands.processes import PrintableLog
from tandem.commands.run import Run
from tandem.console import PlainConsole
from tandem.experiments.simulation.lockstep import simulate
from tandem.live import view
from tandem.live.files import RunFiles
from tandem.live.monitor import Monitor
from tandem.live.screen import Screen
from tandem.live.snapshot import Snapshot
from tandem.live.supervisor import Impatient
from tandem.terminal import Refused
from tests.helpers.paths import ROOT

NASTY = "a\x1b]0;owned\x9b31m\u202eb [red]c :smile:"
SHOWN = r"a\u001b]0;owned\u009b31m\u202eb [red]c :smile:"


def shown(*what: RenderableType) -> str:
    console = PlainConsole()
    with console.capture() as capture:
        for one in what:
            console.print(one, width=200)
    return capture.get()


def nested() -> Table:
    table = Table(title=NASTY)
    table.add_row(NASTY, Text.assemble("x", (NASTY, "bold")))
    return table


@pytest.mark.parametrize("what", [NASTY, Text(NASTY), Panel(NASTY), nested()])
def test_a_strangers_string_is_shown_as_text_everywhere(what: RenderableType) -> None:
    out = shown(what)
    assert SHOWN in out
    assert "\x1b" not in out


def test_an_escaped_text_fits_its_column() -> None:
    console = PlainConsole()
    with console.capture() as capture:
        console.print(Panel(Text("\x1b" * 50, no_wrap=True, overflow="ellipsis")), width=40)
    assert {len(line) for line in capture.get().splitlines()} == {40}


@pytest.fixture
def seen() -> Monitor:
    config = Config()
    monitor = Monitor(config, get_plant(config.plant.model), 20.0)
    said = m.Health(
        run_id=NASTY, seq=0, process="plant", status="running", counters={f"bad_{NASTY}": 1}, note=NASTY
    )
    monitor.feed(Delivery(topics.HEALTH["plant"].key(config.name), codec.encode(said), 0))
    monitor.say(f"{NASTY}\n   3.0 s  all is well", 0.0)
    return monitor


def test_the_live_view_shows_a_health_note_and_an_event_as_text(seen: Monitor) -> None:
    out = shown(view.render(seen.snapshot(0.0), 200, 60))
    assert r"a\u001b]0;owned" in out
    assert "\x1b" not in out


def test_no_event_imitates_another_line(seen: Monitor, capsys: pytest.CaptureFixture[str]) -> None:
    with Screen(PlainConsole(), seen.new_events) as screen:
        screen.show(seen.snapshot(0.0))
    lines = capsys.readouterr().out.splitlines()
    assert any(SHOWN in line for line in lines)
    assert [line for line in lines if "all is well" in line] == [" " * 10 + "   3.0 s  all is well"]


def test_a_process_logs_a_strangers_lines_within_its_own() -> None:
    record = logging.LogRecord(
        "x", logging.INFO, "", 1, "now follows %s", (f"{NASTY}\n12:00 all is well",), None
    )
    assert PrintableLog("%(message)s").format(record) == f"now follows {SHOWN}\n    12:00 all is well"


def test_json_stays_json_and_holds_no_control_characters(capsys: pytest.CaptureFixture[str]) -> None:
    name = b"caf\xe9\x7f".decode(errors="surrogateescape")
    result = {"note": NASTY, "path": Path(name), "inf": math.inf, "deep": [{"nan": math.nan}], "n": 2}
    terminal.emit(result)
    out = capsys.readouterr().out
    assert out.isascii()
    assert out.rstrip("\n").isprintable()
    assert json.loads(out) == {"note": NASTY, "path": name, "inf": None, "deep": [{"nan": None}], "n": 2}


@pytest.mark.parametrize("command", ["replay", "report", "recover"])
def test_the_name_of_a_log_is_shown_as_text(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "a\x1b[2Jb.mcap"
    path.write_bytes(b"no log")
    assert main([command, str(path), "--json"]) != 0
    said = capsys.readouterr()
    assert r"a\u001b[2Jb.mcap" in said.err
    assert "\x1b" not in said.err + said.out


def test_configuration_is_shown_as_toml_without_control_characters(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["config", "show", "--set", 'log.path="a\x9b31m"']) == 0
    out = capsys.readouterr().out
    assert "\x9b" not in out
    assert tomllib.loads(out)["log"]["path"] == "a\x9b31m"


def test_the_screen_does_not_wait_for_a_blocked_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    with open(reading, "rb"), open(writing, "w", encoding="utf-8", buffering=1) as pipe:
        with suppress(BlockingIOError):  # until it is full
            while True:
                os.write(writing, b"x" * 4096)
        console = PlainConsole()
        console.file = pipe
        config = Config()
        monitor = Monitor(config, get_plant(config.plant.model), 20.0)
        now: Snapshot = monitor.snapshot(0.0)
        monitor.say("not lost", 0.0)
        Screen(console, monitor.new_events).show(now)
        assert [event.text for event in monitor.new_events()] == ["not lost"]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["run", "--seconds", "inf"], "--seconds inf: at most 1e+08"),
        (["run", "--seconds", "nan"], "--seconds nan"),
        (["run", "--rate", "1e9"], "--rate: rate = 1000000000.0 is not a number above 0 and at most 100000"),
        (["simulate", "--steps", "1000000000000"], "--steps 1e+12: at most 1e+06"),
        (["health", "plant", "--seconds", "inf"], "--seconds inf: at most 86400"),
        (["sets", "check", "x.json", "--samples", "1000000000000"], "--samples 1e+12: at most 1e+06"),
        (["experiment", "paper", "--out", "x", "--jobs", "1000000"], "--jobs 1e+06: at most 1024"),
        (["run", "--log", "caf\x1b.mcap"], "control characters"),
    ],
)
def test_limits_are_reported(
    arguments: list[str],
    says: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    assert says in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_limits_include_their_ends() -> None:
    terminal.limited("--n", 1, 1, 3)
    terminal.limited("--n", 3, 1, 3)
    for value in (0, 4, math.nan, math.inf, -math.inf):
        with pytest.raises(Refused, match="--n"):
            terminal.limited("--n", value, 1, 3)


# -- after a run ----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> RunFiles:
    log = tmp_path_factory.mktemp("run") / "run.mcap"
    assert main(["simulate", "--steps", "12", "--oracle", "linear", "--log", str(log)]) == 0
    return RunFiles.of(log)


def test_a_second_ctrl_c_while_drawing_keeps_the_figures(
    files: RunFiles, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def pressed(*_: object, **__: object) -> None:
        raise Impatient

    monkeypatch.setattr("matplotlib.figure.Figure.savefig", pressed)
    assert Run(json=True)._conclude(Config(), files, None, True, True) == 130
    said = capsys.readouterr()
    result = json.loads(said.out)
    assert result["ticks"] == 12
    assert "interrupted while drawing; `tandem report" in result["error"]
    assert "ticks" in said.err
    assert not files.picture.exists()


def test_a_machine_has_no_figures_between_samples(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    config = load(ROOT / "examples" / "tanks" / "tanks.toml", ["controller.oracle=linear"])
    save(simulate(config, 5), tmp_path / "run.mcap")
    monkeypatch.setattr("run_log.reporting.report.picture", lambda _run, path: path)
    for no_plant in (False, True):
        ran = Run(json=True, no_plant=no_plant)
        assert ran._conclude(config, RunFiles.of(tmp_path / "run.mcap"), None, True, True) == 0
        figures = json.loads(capsys.readouterr().out)
        assert (figures["excess_between_samples"] is None) == no_plant


def test_a_failed_picture_affects_neither_table_nor_exit_code(
    files: RunFiles, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fails(*_: object, **__: object) -> None:
        raise RuntimeError("latex was not able to process the following string:\nb'lp'\nand so on")

    monkeypatch.setattr("matplotlib.figure.Figure.savefig", fails)
    assert Run(json=True)._conclude(Config(), files, None, True, True) == 0
    said = capsys.readouterr()
    assert json.loads(said.out)["ticks"] == 12
    assert "no picture: " in said.err
    assert "and so on" not in said.err
    assert main(["report", str(files.log), "--json"]) == 1
    report = json.loads(capsys.readouterr().out)
    assert report["ticks"] == 12
    assert len(report["failed"]) == 6
    assert read_run(files.log).truncated is False


def test_a_run_that_is_stopped_during_its_start_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    none = RunFiles.of(tmp_path / "none.mcap")
    assert Run(json=True)._conclude(Config(), none, None, False, False) == 1
    said = capsys.readouterr()
    assert json.loads(said.out) == {"error": "stopped before the first command"}
    assert "stopped before the first command; there is no log. All output is in " in said.err
    assert "recorder" not in said.err
