"""Replay: the log alone gives every command back, byte for byte, and nothing that was changed goes unseen."""

from __future__ import annotations

import copy
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from controller_node.core import ControllerCore
from node_runtime.config.loading import override
from node_runtime.config.sections import Config
from node_runtime.config.strict import ConfigError
from protocol import codec, topics
from protocol import messages as m
from protocol.topics import Topic
from run_log.errors import LogError
from run_log.reading.reader import read_run
from run_log.reading.recover import recover
from run_log.replaying.comparison import first_difference
from run_log.replaying.replay import replay
from run_log.run import Entry, Run, gather
from run_log.writing.save import save
from tandem.experiments.simulation.lockstep import simulate

STEPS, EVERY = 90, 25
RUN = "controller-simulated"
SETTINGS = [
    "controller.horizon=15",
    f"controller.keyframe_every={EVERY}",
    "network.hidden=[8, 8]",
    "trainer.steps=20",
    "log.chunk_bytes=16384",
]


@pytest.fixture(scope="module")
def config() -> Config:
    return override(Config(), SETTINGS)


@pytest.fixture(scope="module")
def log(config: Config, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("replay") / "run.mcap"
    save(simulate(config, STEPS), path)
    return path


@pytest.fixture
def run(log: Path) -> Run:
    return read_run(log)


def edited(run: Run, topic: Topic, seq: int, change: Callable[[Any], m.Message | None]) -> Run:
    """A copy in which one message is another one, or is missing (None)."""
    other = copy.copy(run)
    entries = []
    for entry in run.entries(topic):
        message = change(entry.message) if entry.message.seq == seq else entry.message
        if message is not None:
            entries.append(Entry(entry.log_time, codec.encode(message), message))
    other.streams = {**run.streams, topic.name: entries}
    return other


def with_x(tick: m.Tick, x: list[float]) -> m.Tick:
    assert tick.state is not None
    return msgspec.structs.replace(tick, state=msgspec.structs.replace(tick.state, x=x))


def flip(value: float, bit: int) -> float:
    (bits,) = struct.unpack("<Q", struct.pack("<d", value))
    return struct.unpack("<d", struct.pack("<Q", bits ^ (1 << bit)))[0]


# -- equal -----------------------------------------------------------------------------------------------


def test_every_command_comes_back(run: Run) -> None:
    assert any(r.weights_outcome == "adopted" for r in run.results)
    told = []
    found = replay(run, progress=lambda done, total: told.append((done, total)))
    assert found.equal
    assert found.first_difference is None
    assert (found.ticks, found.first_tick, found.largest_difference) == (STEPS, 0, 0.0)
    assert found.keyframes == 5  # before the first, 24, 49, 74, after the last
    assert told[-1] == (STEPS, STEPS)


@pytest.mark.parametrize(("from_tick", "first"), [(0, 0), (24, 0), (25, 25), (60, 50), (89, 75)])
def test_from_the_middle(run: Run, from_tick: int, first: int) -> None:
    found = replay(run, from_tick)
    assert found.equal
    assert (found.first_tick, found.ticks) == (first, STEPS - first)


@pytest.mark.parametrize("oracle", ["linear", "constant", "l2nw"])
def test_other_oracles(config: Config, oracle: str) -> None:
    run = simulate(override(config, [f"controller.oracle={oracle}"]), 40)
    assert replay(run).equal
    assert replay(run, 30).equal


def test_the_real_time_iteration_replays_too_whether_it_was_prepared_in_time_or_not(config: Config) -> None:
    """Live the next tick is prepared in the idle time; lock-step and replay prepare when the tick is there."""
    fast = override(config, ["controller.solver.mode=real_time"])
    run = simulate(fast, 60)
    assert sum(result.status == "real-time iteration" for result in run.results) >= 55
    assert replay(run).equal
    later = replay(run, from_tick=45)
    assert later.equal
    assert later.ticks < 60
    core = ControllerCore(run.config, run.commands[0].run_id)
    for tick, entry in zip(run.ticks, run.entries(topics.COMMAND), strict=True):
        assert codec.encode(core.step(tick).command) == entry.payload
        core.prepare()


def test_bad_ticks_replay_too(config: Config) -> None:
    """Stale and missing states, refused weights: whatever a tick held, the log has it."""
    from controller_node.core import ControllerCore

    source = simulate(config, 40)
    core = ControllerCore(config, RUN)
    log: list[tuple[Topic, m.Message, int]] = [(topics.KEYFRAME, core.memory.keyframe(-1), 0)]
    weights = source.hidden_weights[0]
    for tick in source.ticks:
        if tick.seq in (7, 8, 30):
            tick = msgspec.structs.replace(tick, state=None, state_verdict="missing")
        elif tick.seq == 12:
            tick = msgspec.structs.replace(tick, state_verdict="stale")
        elif tick.seq == 15:
            tick = msgspec.structs.replace(tick, weights=msgspec.structs.replace(weights, sha256="0" * 64))
        outputs = core.step(tick)
        log += [(topics.TICK, tick, tick.seq), (topics.COMMAND, outputs.command, tick.seq)]
        log += [(topics.RESULT, outputs.result, tick.seq)]
        if tick.seq == 24:
            log.append((topics.KEYFRAME, core.memory.keyframe(24), 24))
    run = gather(config, log)
    assert {r.mode for r in run.results} > {"solver"}
    assert any(r.weights_outcome == "refused" for r in run.results)
    assert replay(run).equal


def test_several_controllers_in_one_log(run: Run, config: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    both = copy.copy(run)
    monkeypatch.setattr("tandem.experiments.simulation.lockstep.CONTROLLER", "controller-2")
    later = simulate(override(config, ["seed=3"]), 30)
    both.streams = {
        name: [
            *run.streams.get(name, []),
            *(Entry(10**10 + e.log_time, e.payload, e.message) for e in later.streams.get(name, [])),
        ]
        for name in run.streams
    }
    found = replay(both)
    assert found.equal
    assert found.run_ids == [RUN, "controller-2"]
    assert found.ticks == STEPS + 30
    assert replay(both, 60).run_ids == [RUN]


# -- not equal -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("seq", "bit"), [(0, 0), (40, 0), (41, 30), (89, 1)])
def test_one_flipped_bit_in_a_tick_is_reported_with_its_tick(run: Run, seq: int, bit: int) -> None:
    changed = edited(
        run, topics.TICK, seq, lambda tick: with_x(tick, [flip(tick.state.x[0], bit), *tick.state.x[1:]])
    )
    found = replay(changed)
    assert not found.equal
    assert found.first_difference is not None
    assert found.first_difference.tick == seq
    assert found.first_difference.run_id == RUN
    assert found.first_difference.recorded != found.first_difference.replayed


@pytest.mark.parametrize("field", ["t", "lateness"])
def test_a_flipped_bit_that_the_step_does_not_use_is_reported_too(run: Run, field: str) -> None:
    changed = edited(
        run,
        topics.TICK,
        7,
        lambda tick: msgspec.structs.replace(tick, **{field: flip(getattr(tick, field), 0)}),
    )
    found = replay(changed)
    assert found.differing_ticks == 1
    assert found.first_difference is not None
    assert found.first_difference.tick == 7
    assert found.first_difference.field == "result.tick_crc32"


def test_one_flipped_bit_in_the_file_survives_a_rewrite_and_is_reported(run: Run, tmp_path: Path) -> None:
    """The edited log is a whole file with valid checksums; only the replay can tell."""
    payload = bytearray(run.entries(topics.TICK)[33].payload)
    x = run.ticks[33].state
    assert x is not None
    place = payload.index(b"\xcb" + struct.pack(">d", x.x[1])) + 8
    payload[place] ^= 1
    entries = list(run.entries(topics.TICK))
    entries[33] = Entry(entries[33].log_time, bytes(payload), entries[33].message)
    run.streams[topics.TICK.name] = entries
    save(run, tmp_path / "edited.mcap")
    first = replay(read_run(tmp_path / "edited.mcap")).first_difference
    assert first is not None
    assert first.tick == 33


def test_a_changed_tolerance_is_reported_with_its_tick(run: Run) -> None:
    found = replay(run, overrides=["controller.solver.tolerance=0.1"])
    assert not found.equal
    assert found.first_difference is not None
    assert found.first_difference.field.startswith("command.u")
    assert found.differing_ticks > 5
    assert found.largest_difference is not None
    assert 0.0 < found.largest_difference < 0.1
    assert any("changed: controller.solver.tolerance=0.1" in note for note in found.notes)


def test_other_changes(run: Run) -> None:
    assert replay(run, overrides=["controller.phase_ms=2"]).equal  # no part of the control law
    seed = replay(run, overrides=["seed=1"]).first_difference
    assert seed is not None
    assert (seed.tick, seed.field[:9]) == (-1, "keyframe.")
    horizon = replay(run, overrides=["controller.horizon=16"])
    assert not horizon.equal
    assert horizon.largest_difference is None
    with pytest.raises(LogError, match="does not fit this configuration"):
        replay(run, 40, overrides=["controller.horizon=16"])
    with pytest.raises(ConfigError, match="tolerence"):
        replay(run, overrides=["controller.solver.tolerence=1"])


@pytest.mark.parametrize(
    ("topic", "seq", "field", "change"),
    [
        (topics.COMMAND, 20, "command.plan[3][0]", lambda c: msgspec.structs.replace(
            c, plan=[*c.plan[:3], [flip(c.plan[3][0], 0)], *c.plan[4:]])),
        (topics.RESULT, 21, "result.weights_verdict", lambda r: msgspec.structs.replace(
            r, weights_verdict="adopted!")),
        (topics.OUTPUT_WEIGHTS, 22, "output_weights.K[", lambda w: msgspec.structs.replace(
            w, K=m.Array.of(np.nextafter(w.K.numpy(), 1)))),
        (topics.KEYFRAME, 49, "keyframe.arrays.", lambda k: msgspec.structs.replace(
            k, arrays={**k.arrays, "pending.x": m.Array.of(k.arrays["pending.x"].numpy() + 1e-16)})),
    ],
)  # fmt: skip
def test_an_edited_output_is_found(
    run: Run, topic: Topic, seq: int, field: str, change: Callable[[Any], m.Message]
) -> None:
    first = replay(edited(run, topic, seq, change)).first_difference
    assert first is not None
    assert first.tick == seq
    assert first.field.startswith(field)


def test_bytes_count_even_where_fields_agree(run: Run) -> None:
    """A command packed in another way reads the same, and is not the same bytes."""
    entries = list(run.entries(topics.COMMAND))
    tree = msgspec.msgpack.decode(entries[5].payload)
    other = msgspec.msgpack.encode(dict(reversed(tree.items())))
    entries[5] = Entry(0, other, entries[5].message)
    run.streams[topics.COMMAND.name] = entries
    first = replay(run).first_difference
    assert first is not None
    assert (first.tick, first.field) == (5, "command (byte 1)")


def test_a_result_of_a_version_before_a_field_replays_where_the_field_is_at_its_default(run: Run) -> None:
    entries = list(run.entries(topics.RESULT))
    for i, entry in enumerate(entries):
        tree = msgspec.msgpack.decode(entry.payload)
        del tree["target_distance"]
        entries[i] = Entry(entry.log_time, msgspec.msgpack.encode(tree), entry.message)
    run.streams[topics.RESULT.name] = entries
    assert replay(run).first_difference is None


def test_difference_sees_signs_of_zero_and_types() -> None:
    assert first_difference([0.0], [0.0], "x") is None
    assert first_difference([0.0], [-0.0], "x") == ("x[0]", 0.0, -0.0)
    assert first_difference([1], [1.0], "x") == ("x[0]", 1, 1.0)
    assert first_difference({"a": None}, {"a": 2}, "x") == ("x.a", None, 2)


# -- gaps ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("first", "count", "again"), [(17, 1, 25), (17, 3, 25), (24, 1, 50), (0, 1, 25), (20, 40, 75)]
)
def test_replay_goes_on_behind_a_gap_and_says_so(run: Run, first: int, count: int, again: int) -> None:
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
    assert note.endswith(f"the recorder lost them; replay goes on at tick {again}, behind the next keyframe")


def test_a_difference_behind_a_gap_is_found(run: Run) -> None:
    run = edited(run, topics.TICK, 17, lambda _: None)
    run = edited(run, topics.COMMAND, 30, lambda c: msgspec.structs.replace(c, u=[flip(c.u[0], 0)]))
    found = replay(run)
    assert found.first_difference is not None
    assert found.first_difference.tick == 30


def test_the_last_tick_of_a_whole_run_may_be_lost_too(run: Run) -> None:
    found = replay(edited(run, topics.TICK, STEPS - 1, lambda _: None))
    assert (found.equal, found.ticks, found.lost_ticks) == (True, STEPS - 1, 1)
    assert any("no keyframe behind it" in note for note in found.notes)


@pytest.mark.parametrize(
    ("topic", "seq", "name"),
    [(topics.COMMAND, 0, "command"), (topics.RESULT, 60, "result"), (topics.KEYFRAME, 49, "keyframe")],
)
def test_what_the_log_lacks_beside_a_tick_is_named(run: Run, topic: Topic, seq: int, name: str) -> None:
    found = replay(edited(run, topic, seq, lambda _: None))
    assert (found.equal, found.ticks, found.lost_ticks) == (True, STEPS, 1)
    assert any(f"not compared, the recorder lost them: {name} of tick {seq} " in note for note in found.notes)


def test_many_gaps_and_unreadable_ticks_are_named(run: Run) -> None:
    run.streams[topics.TICK.name] = [e for e in run.entries(topics.TICK) if e.message.seq % 2]
    run.bad["controller/tick: malformed"] = 45
    found = replay(run)
    # One tick behind the keyframes of 24 and 74; there is none behind that of 49.
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


def test_a_log_that_begins_late_says_from_where_it_can_be_replayed(run: Run) -> None:
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
    """A controller came back while its router was away, and died again before its next keyframe."""
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


def test_a_stranger_does_not_spoil_the_log(run: Run) -> None:
    tick = msgspec.structs.replace(run.ticks[5], run_id="stranger", seq=700)
    run.streams[topics.TICK.name].append(Entry(0, codec.encode(tick), tick))
    found = replay(run)
    assert found.equal
    assert found.ticks == STEPS
    assert any("stranger" in note for note in found.notes)


def test_a_stranger_who_repeats_everything_under_his_own_name_is_named_and_left_out(run: Run) -> None:
    """On a plain endpoint anybody can publish: here all that the run said again, shifted, keyframes too."""
    for topic in (topics.TICK, topics.COMMAND, topics.RESULT, topics.KEYFRAME, topics.RUN_INFO["controller"]):
        for entry in run.entries(topic)[1::2]:
            shifted = {"run_id": "stranger", "seq": entry.message.seq // 2 + 40}
            strange = msgspec.structs.replace(entry.message, **shifted)
            run.streams[topic.name].append(Entry(entry.log_time, codec.encode(strange), strange))
    assert {tick.run_id for tick in run.ticks} & {frame.run_id for frame in run.keyframes} == {
        RUN,
        "stranger",
    }
    found = replay(run)
    assert found.equal
    assert found.run_ids == [RUN]
    assert found.ticks == STEPS
    assert any("not replayed" in note and "stranger" in note for note in found.notes)


def test_asking_for_a_tick_that_is_not_there(run: Run) -> None:
    for tick in (-1, STEPS):
        with pytest.raises(LogError, match=f"no tick {tick}; the log has 0 to 89"):
            replay(run, tick)
    with pytest.raises(LogError, match="nothing to replay"):
        replay(gather(run.config, []))


def test_two_records_of_one_tick_are_refused(run: Run) -> None:
    again = run.entries(topics.TICK)[12]
    run.streams[topics.TICK.name] = [*run.entries(topics.TICK), again]
    assert replay(run).equal  # the same again is harmless
    liar = with_x(again.message, [0.5] * 4)
    run.streams[topics.TICK.name].append(Entry(0, codec.encode(liar), liar))
    with pytest.raises(LogError, match="controller/tick of tick 12 is there twice, and different"):
        replay(run)


def test_a_tick_of_another_plant_is_refused(run: Run) -> None:
    with pytest.raises(LogError, match="tick 4 does not fit the plant"):
        replay(edited(run, topics.TICK, 4, lambda tick: with_x(tick, [0.5])))


# -- logs that end early ---------------------------------------------------------------------------------


def test_a_cut_log_and_what_was_recovered_of_it_replay_up_to_the_cut(log: Path, tmp_path: Path) -> None:
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


def test_a_controller_that_died_may_leave_half_a_tick(run: Run) -> None:
    """Its last health is not "stopping"; then the last tick may lack what was still in the queue."""
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


def said(run: Run, **facts: str | None) -> Run:
    """A copy whose controller says other things of where it ran; None: nothing."""

    def change(info: m.RunInfo) -> m.RunInfo:
        versions = {name: then for name, then in {**info.versions, **facts}.items() if then is not None}
        return msgspec.structs.replace(info, versions=versions)

    return edited(run, topics.RUN_INFO["controller"], 0, change)


def rounded(run: Run, by: float) -> Run:
    """A copy with one input of a plan that is off by so much, in units of u."""

    def change(command: m.Command) -> m.Command:
        plan = [*command.plan[:-1], [command.plan[-1][0] + by]]
        return msgspec.structs.replace(command, plan=plan)

    return edited(run, topics.COMMAND, 7, change)


def test_a_log_says_what_its_arithmetic_depended_on(run: Run) -> None:
    (info,) = run.run_infos
    assert info.versions.keys() >= {"machine", "processor", "kernels", "blas", "numpy", "casadi"}
    assert info.versions["blas"] != "unknown"
    found = replay(run)
    assert (found.equal, found.rounding, found.elsewhere, found.notes) == (True, False, False, [])


@pytest.mark.parametrize(
    ("facts", "by", "rounding", "elsewhere", "note"),
    [
        (
            {"blas": "openblas 0.3 Prescott"},
            1e-12,
            True,
            True,
            "recorded with blas openblas 0.3 Prescott (here ",
        ),
        (
            {"kernels": "not compiled: no C compiler"},
            9e-8,
            True,
            True,
            "kernels not compiled: no C compiler (here ",
        ),
        ({"processor": "another"}, 2e-7, False, True, "equal to about 1e-07 at best, not to the byte"),
        ({"blas": None, "processor": None}, 1e-12, True, None, "the log does not say its processor, blas: "),
        ({}, 1e-12, True, False, ""),
    ],
    ids=["other kernel", "no compiler", "too far", "says nothing of it", "this machine"],
)
def test_a_difference_by_rounding_is_called_that_and_explained(
    run: Run, facts: dict[str, str | None], by: float, rounding: bool, elsewhere: bool | None, note: str
) -> None:
    found = replay(rounded(said(run, **facts), by))
    assert not found.equal
    assert (found.rounding, found.elsewhere) == (rounding, elsewhere)
    assert note in " ".join(found.notes)


def test_a_log_of_another_machine_that_is_equal_all_the_same_says_so(run: Run) -> None:
    found = replay(said(run, processor="another"))
    assert found.equal
    assert any("(here " in note and note.endswith("equal all the same") for note in found.notes)


def test_other_versions_are_mentioned(run: Run) -> None:
    topic = topics.RUN_INFO["controller"]
    changed = edited(
        run,
        topic,
        0,
        lambda info: msgspec.structs.replace(info, versions={**info.versions, "casadi": "0.0.1"}),
    )
    assert any("casadi 0.0.1 (here" in note for note in replay(changed).notes)
