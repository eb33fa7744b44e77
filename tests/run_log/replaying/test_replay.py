"""Replay reproduces every command from the log alone, byte for byte, ignores strangers and refuses unfit logs."""

from __future__ import annotations

import copy

import msgspec
import pytest

from controller_node.core import ControllerCore
from node_runtime.config.loading import override
from node_runtime.config.sections import Config
from protocol import codec, topics
from protocol import messages as m
from protocol.topics import Topic
from run_log.errors import LogError
from run_log.replaying.replay import replay
from run_log.run import Entry, Run, gather
from tandem.experiments.simulation.lockstep import simulate
from tests.run_log.replaying.edited import RUN, STEPS, edited, with_x


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
    """A live controller prepares the next tick in its idle time. Lock-step and replay prepare when the tick arrives."""
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
    """Stale and missing states and refused weights are in the log and in the replay."""
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


def test_a_stranger_does_not_damage_the_log(run: Run) -> None:
    tick = msgspec.structs.replace(run.ticks[5], run_id="stranger", seq=700)
    run.streams[topics.TICK.name].append(Entry(0, codec.encode(tick), tick))
    found = replay(run)
    assert found.equal
    assert found.ticks == STEPS
    assert any("stranger" in note for note in found.notes)


def test_a_stranger_that_repeats_every_message_under_its_own_name_is_named_and_left_out(run: Run) -> None:
    """On a plain endpoint any program can publish. Here a stranger repeats messages of the run with other numbers."""
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
    assert replay(run).equal  # an equal message is harmless
    liar = with_x(again.message, [0.5] * 4)
    run.streams[topics.TICK.name].append(Entry(0, codec.encode(liar), liar))
    with pytest.raises(
        LogError, match="controller/tick of tick 12 is in the log twice with different content"
    ):
        replay(run)


def test_a_tick_of_another_plant_is_refused(run: Run) -> None:
    with pytest.raises(LogError, match="tick 4 does not fit the plant"):
        replay(edited(run, topics.TICK, 4, lambda tick: with_x(tick, [0.5])))
