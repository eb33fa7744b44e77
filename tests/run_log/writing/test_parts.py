"""The log of a long run in parts: each replays alone, no tick is lost between parts, and old parts are removed."""

from __future__ import annotations

import itertools
from pathlib import Path

import pytest

from lbmpc.plants import get_plant
from node_runtime.config.loading import override
from node_runtime.config.sections import Config
from protocol import codec, topics
from protocol import messages as m
from run_log.errors import LogExistsError
from run_log.reading.gaps import lost_ticks
from run_log.reading.reader import read_run
from run_log.replaying.replay import ReplayResult, replay
from run_log.reporting.summary import summarise
from run_log.run import Run, gather
from run_log.writing.parts import WITHOUT_KEYFRAME_S, PartedLog, existing_parts, part_path
from tandem.experiments.simulation.lockstep import simulate

STEPS, EVERY = 160, 20
INFO = m.RunInfo(
    run_id="plant-x", seq=0, process="plant", config="", versions={}, seed=0, units={}, unix_time=0.0
)
SETS = m.CertifiedSets(run_id="another", seq=0, kind="terminal", sha256="", content=b"")


@pytest.fixture(scope="module")
def ran() -> Run:
    """A run with adopted weights and one keyframe per second."""
    settings = ["controller.horizon=10", f"controller.keyframe_every={EVERY}", "network.hidden=[8]"]
    return simulate(override(Config(), [*settings, "trainer.steps=20", "trainer.device=cpu"]), STEPS)


def config(ran: Run, path: Path, *assignments: str) -> Config:
    # A part lasts three seconds, then until the next keyframe, and one second more.
    return override(ran.config, [f'log.path="{path}"', f"log.split_minutes={3 / 60}", *assignments])


def entries(ran: Run) -> list[tuple[str, bytes, int]]:
    """(topic, payload, log_time) in the order in which a recorder receives them, with the controller's run info."""
    said = [
        (entry.log_time, topic.name, entry.payload) for topic in topics.ALL for entry in ran.entries(topic)
    ]
    said.sort(key=lambda one: one[0])
    start = said[0][0]
    once = [(topics.RUN_INFO["plant"].name, INFO), (topics.SETS.name, SETS)]
    return [
        *((name, codec.encode(message), start) for name, message in once),
        *((n, p, t) for t, n, p in said),
    ]


def record(ran: Run, into: Config, heard: list[tuple[str, bytes, int]], *, end: bool = True) -> PartedLog:
    """Write the messages as the recorder does, in the time of the run."""
    start = heard[0][2]
    writer = PartedLog(into, get_plant(into.plant.model), now=0.0, start_ns=start)
    flushed = 0.0
    for name, payload, log_time in heard:
        now = (log_time - start) * 1e-9
        writer.write(name, payload, log_time, now)
        if now >= flushed + 0.25:
            writer.flush(now, log_time)
            flushed = now
    writer.flush(now, log_time)
    if end:
        writer.close()
    return writer


def seams(found: list[ReplayResult]) -> None:
    """Together the replays cover every tick."""
    assert found[0].first_tick == 0
    for before, after in itertools.pairwise(found):
        assert after.first_tick <= before.first_tick + before.ticks
    assert found[-1].first_tick + found[-1].ticks == STEPS


def test_every_part_replays_alone_and_no_tick_is_lost_at_a_seam(ran: Run, tmp_path: Path) -> None:
    heard = entries(ran)
    writer = record(ran, config(ran, tmp_path / "run.mcap"), heard)
    parts = existing_parts(tmp_path / "run.mcap")
    assert [part.name for part in parts] == ["run.mcap", "run.part2.mcap", "run.part3.mcap"]
    runs = [read_run(part) for part in parts]
    found = [replay(run) for run in runs]
    assert [(result.equal, result.lost_ticks) for result in found] == [(True, 0)] * 3
    seams(found)
    assert [(run.part, run.continued) for run in runs] == [
        (1, "run.part2.mcap"),
        (2, "run.part3.mcap"),
        (3, None),
    ]
    assert "continues in run.part2.mcap" in runs[0].note
    for run in runs:
        # Messages that are sent once are in every part, and the edges of a part are no gaps.
        assert [entry.message for entry in run.entries(topics.SETS)] == [SETS]
        assert {info.run_id for info in run.run_infos} == {"plant-x", "controller-simulated"}
        assert summarise(run).lost_ticks == 0
    every = {(name, payload) for name, payload, _ in heard}
    logged = {(name, e.payload) for run in runs for name, stream in run.streams.items() for e in stream}
    assert logged == every
    assert writer.counters["messages"] == len(heard) + 3 * 2  # of three senders, in two parts


def test_a_kill_while_two_parts_overlap_leaves_both_readable(ran: Run, tmp_path: Path) -> None:
    heard = entries(ran)
    into = config(ran, tmp_path / "run.mcap")
    until = heard[0][2] + 4_300_000_000
    record(ran, into, [one for one in heard if one[2] <= until], end=False)
    runs = [read_run(part) for part in existing_parts(tmp_path / "run.mcap")]
    assert [run.truncated for run in runs] == [True, True]
    first, second = (replay(run) for run in runs)
    assert first.equal
    assert second.equal
    assert second.first_tick < first.first_tick + first.ticks


def test_only_as_many_parts_stay_as_are_wanted(ran: Run, tmp_path: Path) -> None:
    record(ran, config(ran, tmp_path / "run.mcap", "log.keep=2"), entries(ran))
    parts = existing_parts(tmp_path / "run.mcap")
    assert [part.name for part in parts] == ["run.part2.mcap", "run.part3.mcap"]
    assert all(replay(read_run(part)).equal for part in parts)


def test_zero_minutes_is_one_file(ran: Run, tmp_path: Path) -> None:
    record(ran, config(ran, tmp_path / "run.mcap", "log.split_minutes=0"), entries(ran))
    assert [part.name for part in existing_parts(tmp_path / "run.mcap")] == ["run.mcap"]


def test_without_a_controller_the_old_part_ends_after_a_while(ran: Run, tmp_path: Path) -> None:
    state = next(entry for entry in ran.entries(topics.PLANT_STATE))
    start = state.log_time
    heard = [
        (topics.PLANT_STATE.name, state.payload, start + second * 1_000_000_000)
        for second in range(60 + int(WITHOUT_KEYFRAME_S) + 10)
    ]
    record(ran, config(ran, tmp_path / "run.mcap", "log.split_minutes=1"), heard, end=False)
    first, second, *_ = runs = [read_run(part) for part in existing_parts(tmp_path / "run.mcap")]
    assert first.continued == "run.part2.mcap"
    assert second.part == 2
    together = [e.log_time for run in runs for e in run.entries(topics.PLANT_STATE)]
    assert set(together) == {time for _, _, time in heard}


def test_nothing_is_overwritten(ran: Run, tmp_path: Path) -> None:
    other = tmp_path / "run.part2.mcap"
    other.write_bytes(b"another file")
    record(ran, config(ran, tmp_path / "run.mcap"), entries(ran))
    assert other.read_bytes() == b"another file"
    assert read_run(tmp_path / "run.mcap").continued == "run.part3.mcap"
    assert read_run(tmp_path / "run.part3.mcap").part == 3
    with pytest.raises(LogExistsError):
        PartedLog(config(ran, tmp_path / "run.mcap"), get_plant("moore_greitzer"), now=0.0, start_ns=0)


def test_an_old_part_is_not_ended_before_the_new_one_can_be_written(ran: Run, tmp_path: Path) -> None:
    folder = tmp_path / "logs"
    heard = entries(ran)
    start = heard[0][2]
    writer = PartedLog(config(ran, folder / "run.mcap"), get_plant("moore_greitzer"), now=0.0, start_ns=start)
    away = tmp_path / "away"
    for name, payload, log_time in heard:
        now = (log_time - start) * 1e-9
        writer.write(name, payload, log_time, now)
        if 2.9 < now < 3.0 and folder.is_dir():
            writer.flush(now, log_time)
            # The disk fails: open files stay open, and no new file can be created.
            folder.rename(away)
            folder.write_bytes(b"")
        if now > 6.0 and not folder.is_dir():
            assert writer.error is not None
            assert existing_parts(folder / "run.mcap") == []
            folder.unlink()
            away.rename(folder)
        writer.flush(now, log_time)
    writer.close()
    runs = [read_run(part) for part in existing_parts(folder / "run.mcap")]
    # The first part continued for as long as the second could not be created.
    assert max(tick.seq for tick in runs[0].ticks) >= 6.0 / runs[0].config.period - 1
    found = [replay(run) for run in runs]
    assert all(result.equal and not result.lost_ticks for result in found)
    seams(found)


def test_the_edges_of_a_part_are_no_gaps(ran: Run) -> None:
    def cut(topic: topics.Topic, first: int, last: int) -> list[tuple[topics.Topic, m.Message, int]]:
        return [(topic, e.message, e.log_time) for e in ran.entries(topic) if first <= e.message.seq <= last]

    # The last messages of tick 19 arrived after the part began, and some of tick 60 arrived after its end.
    told = [*cut(topics.TICK, 20, 60), *cut(topics.COMMAND, 20, 60), *cut(topics.RESULT, 19, 59)]
    run = gather(ran.config, told)
    run.part, run.continued = 2, "run.part3.mcap"
    assert lost_ticks(run) == []
    run.part, run.continued = 1, None
    assert [(first, count) for _, first, count in lost_ticks(run)] == [(19, 1), (60, 1)]


def test_names_of_parts() -> None:
    assert part_path(Path("a/run.mcap"), 1) == Path("a/run.mcap")
    assert part_path(Path("a/run.mcap"), 12) == Path("a/run.part12.mcap")
    assert existing_parts(Path("no/such/folder/run.mcap")) == []
