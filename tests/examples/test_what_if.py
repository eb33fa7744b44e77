"""Commands of a changed setting are computed from a log alone. Without a change they equal the recorded ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from examples.replay.what_if import commanded, main
from run_log.reading.reader import read_run
from tandem import Loop
from tests.helpers.paths import ROOT


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    config = ROOT / "examples" / "tanks" / "tanks.toml"
    loop = Loop(config=config, oracle="constant", controller={"solver": {"compile": "never"}})
    return loop.run(30).save(tmp_path_factory.mktemp("what-if") / "tanks.mcap")


def test_an_unchanged_setting_gives_the_recorded_commands(log: Path) -> None:
    run = read_run(log)
    recorded = np.array([command.u for command in run.commands])
    np.testing.assert_array_equal(commanded(run, "controller.oracle=constant"), recorded)
    linear = commanded(run, "controller.oracle=linear")
    # It does not know the leak, and would command less than the equilibrium of the true tanks needs.
    assert linear[-1, 0] < recorded[-1, 0] - 2.0


def test_the_script_prints_and_draws_how_far_each_change_moves_the_input(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main(log, ("controller.oracle=constant", "controller.R=[0.1]"), tmp_path / "u.png")
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split()[0:4] == ["controller.oracle=constant", "largest", "difference", "0,"]
    assert float(lines[1].split()[3].rstrip(",")) > 1.0
    assert (tmp_path / "u.png").read_bytes().startswith(b"\x89PNG")
