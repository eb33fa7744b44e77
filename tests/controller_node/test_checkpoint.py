"""The checkpoint: complete at every moment, used only by its controller, and the memory of a killed controller."""

from __future__ import annotations

import errno
import logging
import os
import signal
import threading
from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
import pytest

from controller_node.checkpoint import (
    Checkpoint,
    CheckpointError,
    CheckpointWriter,
    OtherController,
    Snapshot,
    read,
    resume,
)
from controller_node.core import ControllerCore
from controller_node.outbox import Outbox
from network_model.description import hash_layers
from node_runtime.bus.zenoh_bus import Bus
from node_runtime.config.loading import load, override
from node_runtime.config.sections import Config
from node_runtime.realtime import clock
from node_runtime.router import open_router
from protocol import codec, topics
from protocol import messages as m
from run_log.replaying.replay import replay
from run_log.run import gather
from tandem.experiments.simulation.lockstep import simulate
from tests.helpers.live import HANG_S, BusListener, Process, health_of, live_config, wait_for

SMALL = ("controller.horizon=20", "network.hidden=[8, 8]", "controller.solver.compile=never")
BELONGS = {"plant": "jet1", "rate": "20.0"}


def sample(seq: int) -> m.Sample:
    return m.Sample(seq, [0.0] * 4, [0.0], [float(seq)] * 4)


def batch(run_id: str, seqs: range) -> m.Samples:
    return m.Samples(run_id=run_id, seq=seqs[-1], samples=[sample(seq) for seq in seqs])


class AnyController:
    """A controller that continues with any checkpoint that belongs to it."""

    def __init__(self, belongs: dict[str, str]):
        self._belongs = belongs

    def belongs(self) -> dict[str, str]:
        return self._belongs

    def go_on(self, lasting: dict[str, m.Array], run_id: str) -> None:
        assert "K" in lasting
        assert run_id == "controller-a"


ME = AnyController(BELONGS)


def counts() -> dict[str, int]:
    return {"checkpoints_written": 0, "checkpoints_failed": 0}


def memory(seq: int = 7) -> Snapshot:
    return Snapshot(seq, {"K": m.Array.of(np.arange(6.0).reshape(2, 3))}, {"ticks": 8})


def written(path: Path, outbox: Outbox | None = None, samples: int = 100) -> Checkpoint:
    with CheckpointWriter(path, BELONGS, outbox or Outbox("controller-a"), samples, counts()) as writer:
        writer.offer(memory())
    return read(path, BELONGS)


# -- the file ------------------------------------------------------------------------------------------------


def test_a_checkpoint_is_read_back(tmp_path: Path) -> None:
    outbox = Outbox("controller-b", earlier=[batch("controller-a", range(3))])
    for seq in range(5):
        outbox.add(sample(seq))
    found = written(tmp_path / "new" / "memory", outbox)
    assert (found.run_id, found.seq, found.counters) == ("controller-b", 7, {"ticks": 8})
    np.testing.assert_array_equal(found.arrays["K"].numpy(), np.arange(6.0).reshape(2, 3))
    batches = [codec.decode(topics.SAMPLES, payload) for payload in found.samples]
    assert batches == [batch("controller-a", range(3)), batch("controller-b", range(5))]
    assert [file.name for file in (tmp_path / "new").iterdir()] == ["memory"]
    assert (tmp_path / "new" / "memory").stat().st_mode & 0o777 == 0o600


def test_only_the_newest_samples_are_saved(tmp_path: Path) -> None:
    outbox = Outbox("controller-b", earlier=[batch("controller-a", range(50))])
    counted = counts()
    with CheckpointWriter(tmp_path / "memory", BELONGS, outbox, 30, counted, every=0.001) as writer:
        for seq in range(60):
            outbox.add(sample(seq))
            if seq % 10 == 9:
                wait_for(lambda: writer.wanted)
                done = counted["checkpoints_written"]
                writer.offer(memory(seq))
                wait_for(lambda done=done: counted["checkpoints_written"] > done)
    saved = [codec.decode_as(m.Samples, payload) for payload in read(tmp_path / "memory", BELONGS).samples]
    assert [each.seq for one in saved for each in one.samples] == list(range(30, 60))
    assert {one.run_id for one in saved} == {"controller-b"}


def spoilt(content: bytes, how: str) -> bytes:
    middle = len(content) // 2
    return {
        "truncated": content[:middle],
        "empty": b"",
        "garbage": b"\x00\xff" * 400,
        "one bit": content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :],
        "longer": content + b"x",
    }[how]


@pytest.mark.parametrize("how", ["truncated", "empty", "garbage", "one bit", "longer"])
def test_a_damaged_file_is_reported_and_renamed(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, how: str
) -> None:
    path = tmp_path / "memory"
    written(path)
    bad = spoilt(path.read_bytes(), how)
    path.write_bytes(bad)
    assert resume(ME, path) is None
    assert str(path) in caplog.text
    assert "starting without memory" in caplog.text
    assert ("sha256 does not match" in caplog.text) is (how not in ("empty", "garbage"))
    assert not path.exists()
    assert (tmp_path / "memory.damaged").read_bytes() == bad


def test_another_controllers_file_is_refused_with_the_differences_and_renamed(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "memory"
    written(path)
    with pytest.raises(OtherController):
        read(path, {**BELONGS, "rate": "50.0"})
    assert resume(AnyController({**BELONGS, "rate": "50.0"}), path) is None
    assert "rate is 20.0 there and 50.0 here" in caplog.text
    assert "plant" not in caplog.text
    assert (tmp_path / "memory.other").exists()
    assert resume(ME, path) is None, "no file remains under the first name"


def test_nonfinite_numbers_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "memory"
    with CheckpointWriter(path, BELONGS, Outbox("controller-a"), 10, counts()) as writer:
        writer.offer(Snapshot(0, {"K": m.Array.of(np.array([1.0, np.nan]))}, {}))
    with pytest.raises(CheckpointError, match="array K is not finite"):
        read(path, BELONGS)


def test_a_full_disk_is_logged_once_counted_and_leaves_the_old_file(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    caplog.set_level(logging.INFO)
    path, counted = tmp_path / "memory", counts()
    written(path)
    before, full, fsync = path.read_bytes(), threading.Event(), os.fsync

    def failing(descriptor: int) -> None:
        if full.is_set():
            raise OSError(errno.ENOSPC, "No space left on device")
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", failing)
    full.set()
    with CheckpointWriter(path, BELONGS, Outbox("controller-a"), 10, counted, every=0.001) as writer:
        for failures in range(3):
            wait_for(lambda: writer.wanted)
            writer.offer(memory(failures))
            wait_for(lambda failures=failures: counted["checkpoints_failed"] > failures)
        assert path.read_bytes() == before
        assert caplog.text.count("No space left on device") == 1
        full.clear()
        wait_for(lambda: writer.wanted)
        writer.offer(memory(99))
    assert caplog.text.count("written again") == 1
    assert read(path, BELONGS).seq == 99
    assert [file.name for file in tmp_path.iterdir()] == ["memory"]


# -- a controller that continues -----------------------------------------------------------------------------


def config(*more: str) -> Config:
    return load(None, [*SMALL, "trainer.steps=5", *more])


def test_a_controller_continues_with_its_memory_and_its_log_replays() -> None:
    before = ControllerCore(config(), "controller-a")
    run = simulate(config(), 80)
    for entry in run.entries(topics.TICK)[:60]:
        before.step(entry.message)
    after = ControllerCore(config(), "controller-b")
    fresh = after.memory.keyframe(-1)
    after.memory.go_on(before.memory.lasting(), "controller-a")
    first = after.memory.keyframe(-1)
    assert first.resumed == "controller-a"
    kept = before.memory.keyframe(59).arrays
    for name, array in first.arrays.items():
        if name.startswith("oracle.") or name == "delay":
            assert array == kept[name], name
        else:
            assert array == fresh.arrays[name], name
    snapshot, then = after.memory.hidden_snapshot(-1), before.memory.hidden_snapshot(59)
    assert snapshot is not None
    assert then is not None
    assert snapshot.hidden_sha256 == then.hidden_sha256
    assert snapshot.hidden_sha256 == hash_layers([layer.numpy() for layer in snapshot.layers])
    # The log of the new run contains its origin from the first tick on, and can be replayed.
    log: list[tuple[topics.Topic, m.Message, int]] = [
        (topics.RUN_INFO["controller"], after.run_info(0.0), 0),
        (topics.KEYFRAME, first, 0),
    ]
    for entry in run.entries(topics.TICK)[59:]:
        tick = msgspec.structs.replace(
            entry.message, run_id="controller-b", seq=entry.message.seq - 59, weights=None
        )
        outputs = after.step(tick)
        if tick.seq == 1:
            # The first complete sample of the new process is the next one that the old process would have learned.
            assert outputs.result.h_hat == run.results[60].h_hat
        log += [(topics.TICK, tick, tick.seq), (topics.COMMAND, outputs.command, tick.seq)]
        log += [(topics.RESULT, outputs.result, tick.seq)]
    log.append((topics.KEYFRAME, after.memory.keyframe(20), 20))
    found = replay(gather(config(), log))
    assert found.equal, found.first_difference
    assert any("continues from the memory of controller-a" in note for note in found.notes)


def test_memory_of_another_shape_is_reported() -> None:
    core, other = ControllerCore(config(), "a"), ControllerCore(config("network.hidden=[9, 8]"), "b")
    with pytest.raises(ValueError, match=r"array oracle\.W1 is"):
        core.memory.go_on(other.memory.lasting(), "b")


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ('name="jet2"', "plant"),
        ("rate=25", "rate"),
        ("network.hidden=[9, 8]", "network"),
        ("controller.oracle=l2nw", "oracle"),
        ("plant.truth.slope=1.4", "truth"),
    ],
)
def test_what_a_checkpoint_belongs_to(change: str, word: str) -> None:
    mine, other = (ControllerCore(c, "a").memory.belongs() for c in (config(), config(change)))
    assert (
        mine == ControllerCore(override(config(), ["seed=5", "controller.horizon=25"]), "b").memory.belongs()
    )
    differing = {name for name in mine | other if mine.get(name) != other.get(name)}
    assert word in differing


def test_the_outbox_includes_earlier_runs_in_a_query_for_all() -> None:
    outbox = Outbox(
        "controller-b", earlier=[batch("controller-a", range(5)), batch("controller-a", range(5, 8))]
    )
    outbox.add(sample(0))

    def answered(**parameters: str) -> list[tuple[str, int]]:
        found = [codec.decode_as(m.Samples, payload) for payload in outbox.answer(parameters)]
        return [(one.run_id, one.seq) for one in found]

    everything = [("controller-a", 4), ("controller-a", 7), ("controller-b", 0)]
    assert answered(run="controller-b", since="-1") == everything
    assert answered(run="controller-b", since="-1", last="5") == everything[1:]
    assert answered(run="controller-b", since="0") == []


# -- real processes ------------------------------------------------------------------------------------------


def play(bus: Bus, states: list[m.PlantState], period: float) -> None:
    """Play a recorded plant, which ignores commands."""
    due = clock.now()
    for state in states:
        due = max(due + period, clock.now())
        clock.sleep_until(due)
        bus.publish(topics.PLANT_STATE, msgspec.structs.replace(state, t=due))


@pytest.mark.live
def test_a_killed_controller_is_restarted_with_its_memory(tmp_path: Path) -> None:
    path = tmp_path / "memory"
    live = live_config(*SMALL, f'controller.checkpoint="{path}"', "rate=50", "trainer.enabled=false")
    states: list[m.PlantState] = simulate(live, 140).plant_states
    belongs = ControllerCore(live, "x").memory.belongs()
    waiting = health_of("controller", note="no plant: waiting for its states")
    with (
        open_router(live),
        Bus(live, "recorder", "recorder-a") as bus,
        Bus(live, "plant", "plant-simulated") as plant,
    ):
        ear = BusListener(bus)
        with Process("controller_node.node", live) as first:
            ear.until(waiting, 60.0)
            play(plant, states[:100], live.period)
            wait_for(lambda: path.exists() and read(path, belongs).counters["ticks"] >= 40)
            first.signal(signal.SIGKILL)
            first.end()
        saved = read(path, belongs)
        killed = saved.run_id
        with Process("controller_node.node", live) as second:
            ear.until(lambda message: waiting(message) and message.run_id != killed, 60.0)
            play(plant, states[100:], live.period)
            asked = [
                codec.decode_as(m.Samples, answer) for answer in bus.ask(topics.OUTBOX_QUERY, {}, HANG_S)
            ]
            second.signal(signal.SIGTERM)
            last = ear.until(health_of("controller", status="stopping"))
            assert second.end() == 0
        assert isinstance(last, m.Health)
        made = last.counters["ticks"] - saved.counters["ticks"]
        wait_for(lambda: sum(result.run_id == last.run_id for result in ear.of(topics.RESULT)) == made)
    old, new = ([r for r in ear.of(topics.RESULT) if (r.run_id == killed) is mine] for mine in (True, False))
    errors = [r.prediction_error for r in old if r.prediction_error is not None]
    again = next(r.prediction_error for r in new if r.prediction_error is not None)
    assert again < 0.25 * errors[0], (errors[0], errors[-1], again)
    assert f"continuing from {killed}" in second.said
    keyframe = next(k for k in ear.of(topics.KEYFRAME) if k.run_id == new[0].run_id)
    assert (keyframe.seq, keyframe.resumed) == (-1, killed)
    assert {name: keyframe.arrays[name] for name in saved.arrays} == saved.arrays
    assert [one.run_id for one in asked] == sorted((one.run_id for one in asked), key=killed.__ne__)
    assert {one.run_id for one in asked} == {killed, new[0].run_id}
    assert last.run_id == new[0].run_id
    assert last.counters["checkpoints_failed"] == 0


@pytest.mark.live
@pytest.mark.parametrize("content", ["garbage", "other"])
def test_a_controller_starts_without_memory_beside_an_unusable_checkpoint(
    tmp_path: Path, content: str
) -> None:
    path = tmp_path / "memory"
    live = live_config(*SMALL, f'controller.checkpoint="{path}"', "rate=50", "trainer.enabled=false")
    if content == "garbage":
        path.write_bytes(os.urandom(5000))
    else:
        other = ControllerCore(override(live, ['name="jet2"', "network.hidden=[9, 8]"]), "controller-z")
        with CheckpointWriter(path, other.memory.belongs(), Outbox("controller-z"), 10, counts()) as writer:
            writer.offer(Snapshot(5, other.memory.lasting(), {"ticks": 1000}))
    states: list[m.PlantState] = simulate(live, 3).plant_states
    with (
        open_router(live),
        Bus(live, "recorder", "recorder-a") as bus,
        Bus(live, "plant", "plant-simulated") as plant,
    ):
        ear = BusListener(bus)
        with Process("controller_node.node", live) as process:
            ear.until(health_of("controller", note="no plant: waiting for its states"), 60.0)
            play(plant, states, live.period)
            ear.until(lambda message: isinstance(message, m.Tick))
            process.signal(signal.SIGTERM)
            assert process.end() == 0
    assert "starting without memory" in process.said
    if content == "other":
        assert "plant is jet2 there and jet1 here" in process.said
        assert "network is" in process.said
    (aside,) = [file for file in tmp_path.iterdir() if file.suffix in (".damaged", ".other")]
    assert aside.suffix == (".damaged" if content == "garbage" else ".other")
    assert ear.of(topics.KEYFRAME)[0].resumed == ""
    # At its orderly end it wrote a checkpoint of its own.
    assert read(path, ControllerCore(live, "x").memory.belongs()).run_id == ear.of(topics.TICK)[0].run_id


@pytest.mark.parametrize("make", [os.mkfifo, lambda path: path.symlink_to("elsewhere")])
def test_a_pipe_or_a_link_as_checkpoint_does_not_block_and_is_kept(
    make: Callable[[Path], None], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "elsewhere").write_bytes(b"not a checkpoint")
    path = tmp_path / "checkpoint"
    make(path)
    kind = path.lstat().st_mode
    assert resume(AnyController(BELONGS), path) is None
    counts_ = counts()
    with CheckpointWriter(path, BELONGS, Outbox("controller-1"), 100, counts_) as writer:
        writer.offer(memory())
    assert counts_["checkpoints_failed"] == 1
    assert path.lstat().st_mode == kind
    assert (tmp_path / "elsewhere").read_bytes() == b"not a checkpoint"
    assert caplog.text.count("only regular files are read, replaced or moved") == 2
