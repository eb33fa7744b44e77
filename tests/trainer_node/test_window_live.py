"""A recurrent network from a file in the real processes: its samples reach the trainer, and weights are adopted."""

from __future__ import annotations

from pathlib import Path

import pytest

from node_runtime.config.architecture import load_architecture
from run_log.reading.reader import read_run
from run_log.replaying.replay import replay
from tests.helpers.launched import launched, small
from tests.helpers.paths import ROOT

GRU = f"{ROOT / 'examples' / 'architecture' / 'gru.py'}:GRU"


@pytest.mark.live
@pytest.mark.long
def test_a_recurrent_network_learns_live_and_its_log_replays(tmp_path: Path) -> None:
    with launched(tmp_path, "--seconds", "5", *small(**{"network.architecture": GRU})) as run:
        code, result = run.ends()
    assert code == 0, run.said
    assert result["weights_adopted"] >= 1
    log = read_run(tmp_path / "run.mcap")
    assert {len(sample.past) for sample in log.samples} == {4}
    # Slots are counted by the clock, including those that a busy machine made the controller miss.
    assert 90 <= log.ticks[-1].slot <= 200
    assert replay(log, architecture=load_architecture(GRU)).equal
