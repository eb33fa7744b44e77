"""A recurrent network in the real processes: samples with their past reach the trainer, its weights come back."""

from __future__ import annotations

from pathlib import Path

import pytest
from test_launch import launched

from run_log.reader import read_run
from run_log.replay import replay

SETTINGS = {
    "network.architecture": "rnn",
    "network.hidden": "[16, 16]",
    "trainer.steps": "50",
    "controller.horizon": "30",
    "controller.solver.compile": "never",
}


@pytest.mark.live
def test_a_recurrent_network_learns_live_and_its_log_replays(tmp_path: Path) -> None:
    settings = [word for key, value in SETTINGS.items() for word in ("--set", f"{key}={value}")]
    with launched(tmp_path, "--seconds", "5", *settings) as run:
        code, result = run.ends()
    assert code == 0, run.said
    assert result["weights_adopted"] >= 1
    assert result["weights_refused"] == 0
    log = read_run(tmp_path / "run.mcap")
    assert {len(sample.past) for sample in log.samples} == {4}
    assert replay(log).equal
