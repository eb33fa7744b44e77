"""`tandem model new` writes a file of two plants that passes the check, runs, converges and replays unchanged."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from run_log.reading.reader import read_run
from run_log.replaying.replay import replay
from tandem.cli import main

Capture = pytest.CaptureFixture[str]


@pytest.fixture(autouse=True)
def in_an_empty_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)


def checked(capsys: Capture, *words: str) -> dict[str, Any]:
    """Return the JSON result of `tandem model check` of a plant without faults."""
    assert main(["model", "check", *words, "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_a_new_plant_file_passes_its_check_runs_converges_and_replays(capsys: Capture) -> None:
    assert main(["model", "new", "my.py"]) == 0
    assert "tandem model check my.py:PLANT" in capsys.readouterr().out
    assert "tandem run --set plant.model=my.py:PLANT" in Path("my.py").read_text()
    for name in ("PLANT", "MATRICES"):
        assert checked(capsys, f"my.py:{name}")["faults"] == []
    quick = ["--oracle", "constant", "--set", "controller.solver.compile=never", "--json"]
    model = ["--set", "plant.model=my.py:PLANT"]
    for words in (model, ["--set", "plant.model=my.py:MATRICES", "--set", "plant.truth=my.py:PLANT"]):
        log = f"run{len(words)}.mcap"
        assert main(["simulate", *words, *quick, "--steps", "110", "--log", log]) == 0
        summary = json.loads(capsys.readouterr().out)
        assert summary["settled_s"] is not None
        assert (summary["constraint_violations"], summary["fallback_ticks"]) == (0, 0)
    Path("my.py").unlink()
    assert replay(read_run("run2.mcap")).equal


def test_both_plants_of_a_new_file_are_the_same_cart(capsys: Capture) -> None:
    main(["model", "new", "my.py"])
    capsys.readouterr()
    equations, numbers = (checked(capsys, f"my.py:{name}") for name in ("PLANT", "MATRICES"))
    for key in ("A", "B", "x_scale", "u_scale", "W"):
        np.testing.assert_allclose(equations[key], numbers[key], rtol=1e-3, atol=1e-12)


def test_a_new_plant_file_overwrites_nothing(tmp_path: Path, capsys: Capture) -> None:
    Path("my.py").write_text("kept")
    for name, message in (
        ("my.py", "my.py: exists already and is not overwritten"),
        ("my.txt", "end in .py"),
        ("away/my.py", "there is no folder"),
        (f"{'x' * 300}.py", "File name too long"),
    ):
        assert main(["model", "new", name]) == 2
        assert message in capsys.readouterr().err
    assert [file.name for file in tmp_path.iterdir()] == ["my.py"]
    assert Path("my.py").read_text() == "kept"


def test_a_name_with_special_characters_does_not_break_the_file(capsys: Capture) -> None:
    strange = 'my """\\N.py'
    assert main(["model", "new", strange]) == 0
    capsys.readouterr()
    checked(capsys, f"{strange}:PLANT")


def test_the_name_may_be_left_out_if_there_is_only_one(capsys: Capture) -> None:
    main(["model", "new", "my.py"])
    capsys.readouterr()
    assert main(["model", "check", "my.py"]) == 2
    seen = capsys.readouterr()
    text = " ".join((seen.out + seen.err).split())
    assert "give the name of the plant: write" in text
    assert "it has PLANT, MATRICES" in text
    Path("one.py").write_text(Path("my.py").read_text().partition("# Without equations")[0])
    checked(capsys, "one.py")
