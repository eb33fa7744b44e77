"""Logs of format 2 are read, replayed and recovered. Their raw channels contain unwrapped bytes."""

from __future__ import annotations

from pathlib import Path

from protocol import codec
from run_log.reading.reader import read_run
from run_log.reading.recover import recover
from run_log.replaying.replay import replay

LOG = Path(__file__).with_name("format2.mcap")
"""`tandem simulate --steps 30` with a small network, by a version that wrote format 2."""


def test_a_log_of_format_2_is_read_and_replayed() -> None:
    run = read_run(LOG)
    assert (len(run.ticks), len(run.results), len(run.commands), run.bad) == (30, 30, 30, {})
    for entries in run.streams.values():
        assert all(codec.encode(entry.message) == entry.payload for entry in entries)
    found = replay(run)
    assert found.ticks == 30
    # The log may come from another machine.
    assert found.largest_difference < 1e-7


def test_a_log_of_format_2_that_was_cut_short_is_recovered(tmp_path: Path) -> None:
    cut, saved = tmp_path / "cut.mcap", tmp_path / "saved.mcap"
    cut.write_bytes(LOG.read_bytes()[:-2000])
    recover(cut, saved)
    assert read_run(saved).ticks == read_run(LOG).ticks
