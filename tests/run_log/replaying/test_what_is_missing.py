"""Replay reports the messages that a log lacks, and replays the ticks after a gap."""

from __future__ import annotations

import zlib
from pathlib import Path

import msgspec
import pytest

from protocol import codec, topics
from protocol import messages as m
from protocol.topics import Topic
from run_log.errors import LogError
from run_log.reading.reader import read_run
from run_log.reading.recover import recover
from run_log.replaying.replay import replay
from run_log.run import Entry, Run
from tests.run_log.replaying.edited import RUN, STEPS, edited, flip

# -- gaps ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("first", "count", "again"), [(17, 1, 25), (17, 3, 25), (24, 1, 50), (0, 1, 25), (20, 40, 75)]
)
def test_replay_continues_after_a_gap_and_says_so(run: Run, first: int, count: int, again: int) -> None:
    for topic in (topics.TICK, topics.COMMAND, topics.RESULT, topics.KEYFRAME):
        run.streams[topic.name] = [
            e for e in run.entries(topic) if not first <= e.message.seq < first + count
        ]
    found = replay(run)
    assert found.equal
    assert found.ticks == first + STEPS - again
    assert found.lost_ticks == again - first
    (note,) = (note for note in found.notes if "gap" in note)
    ticks = "1 tick" if count == 1 else f"{count} ticks"
    assert note.startswith(f"gap of {ticks} at tick {first} of ")
    assert note.endswith(f"the recorder lost them; replay continues at tick {again}, after the next keyframe")


def test_a_difference_behind_a_gap_is_found(run: Run) -> None:
    run = edited(run, topics.TICK, 17, lambda _: None)
    run = edited(run, topics.COMMAND, 30, lambda c: msgspec.structs.replace(c, u=[flip(c.u[0], 0)]))
    found = replay(run)
    assert found.first_difference is not None
    assert found.first_difference.tick == 30


def test_the_last_tick_of_a_whole_run_may_be_lost_too(run: Run) -> None:
    found = replay(edited(run, topics.TICK, STEPS - 1, lambda _: None))
    assert (found.equal, found.ticks, found.lost_ticks) == (True, STEPS - 1, 1)
    assert any("no later keyframe" in note for note in found.notes)


@pytest.mark.parametrize(
    ("topic", "seq", "name"),
    [(topics.COMMAND, 0, "command"), (topics.RESULT, 60, "result"), (topics.KEYFRAME, 49, "keyframe")],
)
def test_missing_messages_of_a_tick_are_named(run: Run, topic: Topic, seq: int, name: str) -> None:
    found = replay(edited(run, topic, seq, lambda _: None))
    assert (found.equal, found.ticks, found.lost_ticks) == (True, STEPS, 1)
    assert any(
        f"not compared because the recorder lost them: {name} of tick {seq} " in note for note in found.notes
    )


def test_many_gaps_and_unreadable_ticks_are_named(run: Run) -> None:
    run.streams[topics.TICK.name] = [e for e in run.entries(topics.TICK) if e.message.seq % 2]
    run.bad["controller/tick: malformed"] = 45
    found = replay(run)
    # One tick after the keyframes of 24 and 74; none after that of 49.
    assert (found.equal, found.ticks, found.lost_ticks) == (True, 2, STEPS - 2)
    gaps = [note for note in found.notes if note.startswith("gap of 1 tick at tick ")]
    assert len(gaps) == 3
    assert all("not readable: 45 controller/tick: malformed" in note for note in gaps)


def test_a_log_without_any_tick_to_replay_is_refused(run: Run) -> None:
    run.streams[topics.TICK.name] = [
        e for e in run.entries(topics.TICK) if e.message.seq % 2 and e.message.seq < 24
    ]
    with pytest.raises(LogError, match=r"no tick can be replayed: gap of 1 tick at tick 0"):
        replay(run)


def test_a_gap_before_the_start_does_not_matter(run: Run) -> None:
    assert replay(edited(run, topics.TICK, 17, lambda _: None), 40).ticks == STEPS - 25


def test_a_log_that_begins_late_names_its_first_replayable_tick(run: Run) -> None:
    """The recorder was started after the controller."""
    for topic in (topics.TICK, topics.COMMAND, topics.RESULT, topics.KEYFRAME):
        run.streams[topic.name] = [e for e in run.entries(topic) if e.message.seq >= 30]
    found = replay(run)
    assert (found.equal, found.first_tick, found.ticks, found.lost_ticks) == (True, 50, STEPS - 50, 20)
    (note,) = (note for note in found.notes if "memory" in note)
    assert note.startswith(f"no keyframe before tick 0 of {RUN} is in the log")
    assert note.endswith("replay begins at tick 50")
    with pytest.raises(LogError, match=r"no keyframe before tick 40.*use --from-tick 50"):
        replay(run, 40)
    assert replay(run, 50).lost_ticks == 0


def test_a_run_without_a_keyframe_does_not_keep_the_others_from_being_replayed(run: Run) -> None:
    """A controller restarted while its router was down, and died again before its next keyframe."""
    second, sums = "controller-second", {}
    for topic in (topics.TICK, topics.COMMAND, topics.RESULT, topics.RUN_INFO["controller"]):
        for entry in run.entries(topic)[:10]:
            again = msgspec.structs.replace(entry.message, run_id=second)
            if topic is topics.TICK:
                sums[again.seq] = zlib.crc32(codec.encode(again))
            elif topic is topics.RESULT:
                again = msgspec.structs.replace(again, tick_crc32=sums[again.seq])
            run.streams[topic.name].append(Entry(entry.log_time, codec.encode(again), again))
    found = replay(run)
    assert (found.equal, found.ticks, found.lost_ticks) == (True, STEPS, 10)
    assert any(second in note and "none of it can be replayed" in note for note in found.notes)


# -- logs that end early ---------------------------------------------------------------------------------


def test_a_cut_log_and_its_recovered_copy_replay_up_to_the_cut(log: Path, tmp_path: Path) -> None:
    data = log.read_bytes()
    cut, whole = tmp_path / "cut.mcap", tmp_path / "whole.mcap"
    for share in (0.5, 0.63, 0.8):
        cut.write_bytes(data[: int(len(data) * share)])
        found = replay(read_run(cut))
        assert found.equal
        assert 10 < found.ticks < STEPS
        assert any("tandem recover" in note for note in found.notes)
        whole.unlink(missing_ok=True)
        recover(cut, whole)
        again = replay(read_run(whole))
        assert again.equal
        assert again.ticks == found.ticks


def test_a_killed_controller_may_leave_an_incomplete_tick(run: Run) -> None:
    """Its last health is not "stopping", so messages of the last tick may have been lost in the queue."""
    health = m.Health(run_id=RUN, seq=0, process="controller", status="running", counters={}, note="")
    died = edited(run, topics.RESULT, STEPS - 1, lambda _: None)
    assert any("result of tick 89" in note for note in replay(died).notes)
    died.streams[topics.HEALTH["controller"].name] = [Entry(0, codec.encode(health), health)]
    found = replay(died)
    assert found.equal
    assert found.ticks == STEPS - 1
    assert any("up to tick 88" in note for note in found.notes)
    stopping = msgspec.structs.replace(health, seq=1, status="stopping")
    died.streams[topics.HEALTH["controller"].name].append(Entry(1, codec.encode(stopping), stopping))
    assert any("result of tick 89" in note for note in replay(died).notes)
