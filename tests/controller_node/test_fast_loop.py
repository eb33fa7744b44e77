"""The controller in a fast loop: its publications and their times, and the phase after the samples."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from concurrent.futures import Executor
from typing import cast

import numpy as np
import pytest

from benchmarks.live.wakeups import Wakeups, measure
from controller_node.core import ControllerCore
from controller_node.node import ControllerNode, Latched
from controller_node.phase import phase, with_input_delay
from controller_node.tally import COUNTS
from network_model.description import hash_layers
from node_runtime.bus.inbox import Received
from node_runtime.bus.mailbox import Mailbox
from node_runtime.bus.zenoh_bus import Bus
from node_runtime.config.loading import from_json, override, to_json
from node_runtime.config.sections import Config
from node_runtime.health import HealthPublisher
from node_runtime.realtime.pacer import Slot
from node_runtime.rejected import RejectedMessages
from protocol import codec, topics
from protocol import messages as m
from protocol.topics import Topic
from trainer_node.descent import descend
from trainer_node.node import COUNTERS, TRAIN_EVERY, TrainerNode
from trainer_node.training import Trainer


class BusThatWritesDown:
    """Replaces a bus and records the published messages in order."""

    def __init__(self, config: Config):
        self.config = config
        self.bad = RejectedMessages()
        self.said: list[tuple[str, m.Message | None]] = []

    def queue(self, topic: Topic, capacity: int, arrived: threading.Condition | None = None) -> Mailbox:
        return Mailbox(topic.name, capacity, arrived=arrived)

    def serve(self, name: str, handler: object) -> None:
        pass

    def ask(self, name: str, parameters: dict[str, str], timeout_s: float) -> list[bytes]:
        return []

    def when_heard(self, topic: Topic, call: Callable[[int], None]) -> None:
        self.heard = call

    def publish(self, topic: Topic, message: m.Message) -> None:
        self.said.append((topic.name, message))

    def seqs(self, topic: Topic) -> list[int]:
        return [message.seq for name, message in self.said if name == topic.name and message is not None]


class Loop:
    """A controller's node without a clock; `tick` runs one turn."""

    def __init__(self, *assignments: str):
        small = ("controller.horizon=4", "network.hidden=[4]", "controller.solver.compile=never")
        config = override(Config(), [*small, *assignments])
        self.bus = BusThatWritesDown(config)
        self.core = ControllerCore(config, "controller-a")
        prepare = self.core.prepare

        def noted() -> None:
            self.bus.said.append(("prepare", None))
            prepare()

        self.core.prepare = noted
        self.node = ControllerNode(
            self.core, cast(Bus, self.bus), cast(HealthPublisher, None), dict.fromkeys(COUNTS, 0)
        )

    def tick(self, times: int = 1) -> None:
        for _ in range(times):
            k, period, plant = self.node._seq + 1, self.core.config.period, self.core.plant
            state = m.PlantState(
                run_id="plant-a",
                seq=k,
                t=k * period,
                x=plant.x_e.tolist(),
                applied=plant.u_e.tolist() if k else None,
                source="command",
                command_seq=k - 1,
            )
            received = Received(state, k * period, k * period)
            self.node._tick(Slot(k, k * period, 0), 0.0, Latched("fresh", received, 0.0))


def test_every_tick_is_published_and_weights_fifty_times_a_second() -> None:
    loop = Loop("rate=1000")
    loop.tick(250)
    for topic in (topics.TICK, topics.COMMAND, topics.RESULT, topics.TIMING):
        assert loop.bus.seqs(topic) == list(range(250))
    assert loop.bus.seqs(topics.OUTPUT_WEIGHTS) == list(range(0, 250, 20))
    # Samples of a tenth of a second are sent together.
    assert loop.bus.seqs(topics.SAMPLES) == [99, 199]


def test_at_twenty_hertz_every_tick_publishes_everything() -> None:
    loop = Loop("rate=20")
    loop.tick(11)
    assert loop.bus.seqs(topics.OUTPUT_WEIGHTS) == list(range(11))
    assert loop.bus.seqs(topics.SAMPLES) == [4, 9]


def test_a_new_listener_gets_a_keyframe_before_each_pending_tick() -> None:
    loop = Loop("rate=20")
    keyframes = loop.node._keyframes
    loop.bus.heard(0)
    keyframes.begin()
    loop.tick(6)
    keyframes.greet(5, now=1.0)
    # This listener was present from the start.
    assert loop.bus.seqs(topics.KEYFRAME) == [-1]
    # Two and a half ticks were not sent yet, and one more may have followed.
    loop.bus.heard(7)
    keyframes.greet(5, now=2.0)
    assert loop.bus.seqs(topics.KEYFRAME) == [-1, 1, 2, 3, 4, 5]
    kept = {frame.seq: frame for name, frame in loop.bus.said if name == topics.KEYFRAME.name}
    again = ControllerCore(loop.core.config, "controller-a")
    again.memory.restore(kept[2])
    for tick in [message for name, message in loop.bus.said if name == topics.TICK.name][3:]:
        again.step(tick)
    assert codec.encode(again.memory.keyframe(5)) == codec.encode(kept[5])
    loop.tick()
    keyframes.greet(6, now=2.5)
    keyframes.greet(6, now=3.0)
    keyframes.greet(6, now=4.0)
    assert loop.bus.seqs(topics.KEYFRAME)[6:] == [6]


def test_an_adoption_is_published_at_once() -> None:
    loop = Loop("rate=1000", "adaptation.trial.enabled=false")
    loop.tick(5)
    description = loop.core.controller.oracle.description
    assert description is not None
    layers = [np.full(shape, 0.125) for shape in description.layer_shapes]
    loop.node._weights = m.HiddenWeights(
        run_id="trainer-a",
        seq=1,
        for_run="controller-a",
        trained_on=0,
        base_sha256="",
        samples=1,
        loss_before=1.0,
        loss_after=0.5,
        network_sha256=description.sha256(),
        sha256=hash_layers(layers),
        layers=[m.Array.of(layer, "<f4") for layer in layers],
    )
    loop.tick(5)
    assert loop.bus.seqs(topics.OUTPUT_WEIGHTS) == [0, 5]


@pytest.mark.parametrize(("rate", "times"), [("20.0", 3), ("100.0", 3), ("200.0", 0)])
def test_a_backup_follows_each_command_at_low_rates(rate: str, times: int) -> None:
    loop = Loop(f"rate={rate}")
    loop.tick(3)
    assert loop.bus.seqs(topics.BACKUP) == list(range(times))
    names = [name for name, _ in loop.bus.said]
    assert all(names[names.index(topics.BACKUP.name) - 1] == topics.COMMAND.name for _ in range(times))


@pytest.mark.parametrize(("measured", "times"), [('["z", "y"]', 0), ('["z", "y", "r", "rdot"]', 2)])
def test_no_backup_with_unmeasured_states(measured: str, times: int) -> None:
    loop = Loop("rate=20.0", "estimator.kind=kalman", f"estimator.measured={measured}")
    loop.tick(2)
    assert loop.bus.seqs(topics.BACKUP) == list(range(times))


def test_the_next_tick_is_prepared_right_after_the_command() -> None:
    loop = Loop("controller.solver.mode=real_time", "controller.backup.enabled=false")
    loop.tick(3)
    loop.bus.said.clear()
    loop.tick()
    assert [name for name, _ in loop.bus.said][:3] == [topics.COMMAND.name, "prepare", topics.TICK.name]
    assert loop.core.controller._prepared_for is loop.core.memory.state


def test_trainings_have_a_minimum_interval(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    config = override(Config(), ["rate=1000"])
    bus, counts = cast(Bus, BusThatWritesDown(config)), dict.fromkeys(COUNTERS, 0)
    node = TrainerNode(config, bus, cast(HealthPublisher, None), counts, cast(Executor, None))
    began: list[float] = []
    monkeypatch.setattr(node, "_may_train", lambda: True)
    monkeypatch.setattr(node, "_must_join", lambda: False)
    for now in (10.0 + 0.02 * k for k in range(100)):
        node.listen(now)
        if node.waits_since(now) is not None:
            began.append(now)
            node.rest(now, took=0.01)
    assert len(began) == pytest.approx(2.0 / TRAIN_EVERY, abs=1)
    assert min(np.diff(began)) >= TRAIN_EVERY - 1e-9
    # At 20 Hz ten samples take longer than this interval, so it has no effect.
    assert Config().trainer.train_every * Config().period > TRAIN_EVERY


class Notes:
    """Replaces a health publisher and records its notes in order."""

    def __init__(self) -> None:
        self.said: list[tuple[str, str]] = []

    def set(self, status: str, note: str = "") -> None:
        self.said.append((status, note))


def test_health_and_log_report_the_benefit_of_a_training(caplog: pytest.LogCaptureFixture) -> None:
    config = override(Config(), ["trainer.steps=3"])
    bus, counts, notes = cast(Bus, BusThatWritesDown(config)), dict.fromkeys(COUNTERS, 0), Notes()
    node = TrainerNode(config, bus, cast(HealthPublisher, notes), counts, cast(Executor, None))
    core = ControllerCore(config, "controller-a")
    description = core.controller.oracle.description
    assert description is not None
    hidden = [layer.numpy().astype(float) for layer in core.memory.hidden_snapshot(-1).layers]
    node._trainer = trainer = Trainer(description, config.trainer, 0, "trainer-a", hidden)
    scale = np.array(description.output_scale)
    K = m.Array.of(np.zeros((description.features, 4)))
    output = m.OutputWeights(
        run_id="controller-a", seq=0, hidden_version=0, hidden_sha256=trainer.sha256, K=K
    )
    with caplog.at_level(logging.INFO, "trainer_node.node"):
        for variance in ([], (scale**2).tolist(), (scale**2).tolist()):
            first = len(trainer.buffer)
            new = [m.Sample(first + k, [0.1] * 4, [0.1], [0.0] * 4, variance=variance) for k in range(20)]
            trainer.add("controller-a", new)
            draw = trainer.begin(output, "controller-a")
            assert draw is not None
            node.finish(draw, descend(draw.problem, 3, 1e-3))
    nothing = "following ; training has nothing to gain (0.0% of the labels' variance)"
    assert notes.said == [("running", "following "), ("running", nothing), ("running", nothing)]
    # It is logged once, and not after every training.
    assert [record.getMessage() for record in caplog.records] == [nothing]


@pytest.mark.parametrize(
    ("assignments", "seconds"),
    [(["rate=20"], 1e-3), (["rate=1000"], 2.5e-4), (["rate=1000", "controller.phase_ms=0.3"], 3e-4)],
)
def test_the_phase_is_a_millisecond_or_a_quarter_of_a_period(assignments: list[str], seconds: float) -> None:
    assert phase(override(Config(), assignments)) == pytest.approx(seconds)


@pytest.mark.parametrize(
    ("assignments", "ms"),
    [
        (["rate=20"], 5.0),
        (["rate=1000"], 0.35),
        (["controller.phase_ms=24"], 25.0),
        (["controller.input_delay_ms=7"], 7.0),
    ],
)
def test_the_initial_live_delay_is_the_usual_response_time(assignments: list[str], ms: float) -> None:
    settled = with_input_delay(override(Config(), assignments))
    assert settled.controller.input_delay_ms == pytest.approx(ms)
    # The delay is in the log, so a replay starts with it.
    assert from_json(to_json(settled)) == settled


@pytest.mark.parametrize(("rate", "every"), [(1, 1), (20, 1), (50, 1), (51, 2), (100, 2), (1000, 20)])
def test_the_rate_in_the_topic_table_is_kept(rate: float, every: int) -> None:
    assert topics.OUTPUT_WEIGHTS.every(1 / rate) == every
    assert topics.TICK.every(1 / rate) == 1


def command(*plan: float) -> m.Command:
    entries = [[value] for value in plan]
    return m.Command(
        run_id="c",
        seq=0,
        state_run_id="p",
        state_seq=0,
        period=1.0,
        mode="solver",
        u=entries[0],
        plan=entries,
    )


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), float("-inf")])
@pytest.mark.parametrize("place", [0, 1, 19])
def test_a_single_nonfinite_number_is_found(bad: float, place: int) -> None:
    plan = [1.0] * 20
    plan[place] = bad
    with pytest.raises(codec.BadMessage, match="not finite"):
        codec.decode(topics.COMMAND, codec.encode(command(*plan)))


def test_finite_numbers_with_an_overflowing_sum_are_accepted() -> None:
    message = command(*[1e308] * 20)
    assert codec.decode(topics.COMMAND, codec.encode(message)) == message


def test_the_empty_loop_counts_every_slot() -> None:
    found = measure(Wakeups(rate=200.0, seconds=0.1, priority=0))
    assert found["slots"] >= 20
    assert 0.0 <= found["off_percent"] <= 100.0
