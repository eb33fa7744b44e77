"""The live controller as a process on a real bus: its messages, the weights it accepts, and its end."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import msgspec
import numpy as np
import pytest

from controller_node import node
from controller_node.core import ControllerCore
from network_model.description import NetworkDescription, hash_layers
from node_runtime.bus.zenoh_bus import Bus
from node_runtime.config.sections import Config
from node_runtime.realtime.scheduling import one_blas_thread
from node_runtime.router import open_router
from protocol import codec, topics
from protocol import messages as m
from tandem.operating.commander import commanding
from tandem.operating.set_points import set_point
from tests.helpers.live import HANG_S, BusListener, Process, health_of, live_config, matched, wait_for

FLOOD = 300
SETTINGS = ("controller.horizon=20", "controller.keyframe_every=20", "network.hidden=[8, 8]")


@dataclass
class Run:
    """The messages of one run, and the answers to the queries near its end."""

    config: Config
    ear: BusListener
    run_id: str
    outbox: list[m.Sample]
    snapshot: m.HiddenSnapshot
    after_refusal: m.HiddenSnapshot
    said: str

    def of(self, topic: topics.Topic) -> list:
        return self.ear.of(topic)

    @property
    def counters(self) -> dict[str, int]:
        return self.of(topics.HEALTH["controller"])[-1].counters


def weights(snapshot: m.HiddenSnapshot, version: int, **changes: object) -> m.HiddenWeights:
    """Return a trainer's answer to the controller's present hidden weights."""
    description = msgspec.json.decode(snapshot.description, type=NetworkDescription)
    layers = [array.numpy() * np.float32(1.0001) for array in snapshot.layers]
    good = m.HiddenWeights(
        run_id="trainer-a",
        seq=version,
        for_run=snapshot.run_id,
        trained_on=0,
        base_sha256=snapshot.hidden_sha256,
        samples=100,
        loss_before=1.0,
        loss_after=0.5,
        network_sha256=description.sha256(),
        sha256=hash_layers(layers),
        layers=[m.Array.of(layer, "<f4") for layer in layers],
    )
    return msgspec.structs.replace(good, **changes)


def snapshot_of(bus: Bus) -> m.HiddenSnapshot:
    answers: list[bytes] = []
    wait_for(lambda: answers.extend(bus.ask(topics.HIDDEN_QUERY, {}, 2.0)) or bool(answers))
    return codec.decode_as(m.HiddenSnapshot, answers[0])


def tick_with_weights(message: m.Message) -> bool:
    return isinstance(message, m.Tick) and message.weights is not None


def command(config: Config) -> None:
    """Send a set-point, one that is outside X, and a thousand per second for some time."""
    with commanding(config, topics.RESULT) as commander:
        asked = [set_point({"y": y}) for y in (1.7, 5.0)]
        for one in asked:
            assert commander.keep_saying(one, 0.2, HANG_S, answers(commander.run_id))
        for _ in range(FLOOD):
            commander.say(asked[0])
            time.sleep(1e-3)


def answers(to: str) -> Callable[[m.Message], bool]:
    return lambda message: isinstance(message, m.TickResult) and message.reference_from == to


@pytest.fixture(scope="module")
def run() -> Iterator[Run]:
    config = live_config(*SETTINGS)
    with (
        open_router(config),
        Bus(config, "trainer", "trainer-a") as trainer,
        Process("plant_sim.node", config),
    ):
        ear = BusListener(trainer)
        ear.until(health_of("plant", status="ready"))
        with Process("controller_node.node", config) as process:
            ear.until(lambda message: isinstance(message, m.Tick))
            snapshot = snapshot_of(trainer)
            wait_for(lambda: matched(trainer, topics.HIDDEN_WEIGHTS))
            trainer.publish(topics.HIDDEN_WEIGHTS, weights(snapshot, 1, for_run="controller-other"))
            trainer.publish(topics.HIDDEN_WEIGHTS, weights(snapshot, 2, sha256="0" * 64))
            ear.until(tick_with_weights)
            wait_for(lambda: snapshot_of(trainer).judged_version == 2)
            after_refusal = snapshot_of(trainer)
            # Adoption needs samples for the trial.
            ear.until(lambda message: isinstance(message, m.Samples) and message.seq >= 15)
            trainer.publish(topics.HIDDEN_WEIGHTS, weights(snapshot, 3))
            ear.until(tick_with_weights)
            command(config)
            wait_for(lambda: sum(tick.state_verdict == "fresh" for tick in ear.of(topics.TICK)) >= 40)
            snapshot = snapshot_of(trainer)
            answer = trainer.ask(topics.OUTBOX_QUERY, {"since": "-1"}, HANG_S)
            process.signal(signal.SIGINT)
            ear.until(health_of("controller", status="stopping"))
            assert process.end() == 0
        batches = [codec.decode_as(m.Samples, payload) for payload in answer]
        outbox = [one for batch in batches for one in batch.samples]
        yield Run(config, ear, snapshot.run_id, outbox, snapshot, after_refusal, process.said)


@pytest.mark.live
def test_every_tick_has_all_its_messages(run: Run) -> None:
    ticks = run.of(topics.TICK)
    count = len(ticks)
    assert [tick.seq for tick in ticks] == list(range(count))
    for topic in (topics.COMMAND, topics.RESULT, topics.TIMING, topics.OUTPUT_WEIGHTS):
        assert [message.seq for message in run.of(topic)] == list(range(count))
    skipped = np.cumsum([tick.skipped for tick in ticks])
    assert [tick.slot for tick in ticks] == [
        tick.seq + extra for tick, extra in zip(ticks, skipped, strict=True)
    ]
    for tick, command in zip(ticks, run.of(topics.COMMAND), strict=True):
        if tick.state_verdict == "fresh":
            assert (command.state_run_id, command.state_seq) == (tick.state.run_id, tick.state.seq)
    assert {message.run_id for message in run.of(topics.COMMAND)} == {run.run_id}


@pytest.mark.live
def test_the_slots_have_a_constant_phase_after_the_samples(run: Run) -> None:
    ticks = [tick for tick in run.of(topics.TICK) if tick.state_verdict == "fresh"]
    # Both clocks are this machine's, so a slot minus its sample's time is the delay plus the phase.
    behind = np.array([tick.t - tick.state.t for tick in ticks[10:]])
    # Late slots, and those that waited for the plant, do not show the grid. Slots without phase control would differ by
    # a quarter of a period in the median.
    assert np.median(np.abs(behind - np.median(behind))) < 0.1 * run.config.period
    answered = [tick.state.seq for tick in ticks]
    assert answered == sorted(set(answered))


@pytest.mark.live
def test_a_run_starts_and_ends_with_keyframes(run: Run) -> None:
    last = run.of(topics.TICK)[-1].seq
    expected = [-1, *range(19, last + 1, 20)]
    assert [frame.seq for frame in run.of(topics.KEYFRAME)] == expected + [last] * (expected[-1] != last)


@pytest.mark.live
def test_samples_are_sent_in_batches_and_the_outbox_has_all(run: Run) -> None:
    batches = run.of(topics.SAMPLES)
    *sizes, last = (len(batch.samples) for batch in batches)
    assert max(*sizes, last) == 5
    # Smaller batches are sent when the controller waits for its plant, which can happen on a busy machine.
    without_state = sum(tick.state_verdict != "fresh" for tick in run.of(topics.TICK))
    assert sum(size < 5 for size in sizes) <= without_state // run.config.controller.horizon
    published = [one for batch in batches for one in batch.samples]
    assert run.outbox
    assert published[: len(run.outbox)] == run.outbox
    assert len({one.seq for one in published}) == len(published)


@pytest.mark.live
def test_the_ticks_alone_reproduce_every_command(run: Run) -> None:
    with one_blas_thread():
        core = ControllerCore(run.config, run.run_id)
        core.memory.restore(run.of(topics.KEYFRAME)[0])
        again = [codec.encode(core.step(tick).command) for tick in run.of(topics.TICK)]
    assert again == [codec.encode(command) for command in run.of(topics.COMMAND)]


@pytest.mark.live
def test_weights_are_adopted_refused_or_dropped(run: Run) -> None:
    latched = [tick.weights.seq for tick in run.of(topics.TICK) if tick.weights is not None]
    assert latched == [2, 3]
    verdicts = [
        result.weights_verdict for result in run.of(topics.RESULT) if result.weights_outcome != "none"
    ]
    assert len(verdicts) == 2
    assert verdicts[0].startswith("refused: ")
    assert verdicts[1] == "adopted"
    assert run.counters["weights_adopted"] == 1
    assert run.counters["weights_refused"] == 1
    assert run.counters["bad_trainer_hidden_weights_for_another_run"] == 1
    assert run.counters["bad_trainer_hidden_weights_refused"] == 1
    assert run.said.count("for another run") == 1
    assert run.snapshot.hidden_version == 3


@pytest.mark.live
def test_references_are_answered_and_a_flood_is_reduced_to_one_per_tick(run: Run) -> None:
    verdicts = [r.reference_verdict for r in run.of(topics.RESULT) if r.reference_verdict != "none"]
    assert verdicts[0] == "taken"
    assert any(verdict.startswith("refused: y = 5 is outside X") for verdict in verdicts)
    assert verdicts[-1] == "taken"
    assert run.of(topics.RESULT)[-1].reference == pytest.approx({"y": 1.7})
    lost = [
        run.counters.get(name, 0)
        for name in ("overflow_operator_reference", "bad_operator_reference_superseded")
    ]
    assert sum(lost) > FLOOD // 2
    assert run.counters["bad_operator_reference_refused"] == len([v for v in verdicts if v != "taken"])
    assert run.counters["references_taken"] == verdicts.count("taken")


@pytest.mark.live
def test_a_query_returns_the_last_decision_on_weights(run: Run) -> None:
    refused, adopted = run.after_refusal, run.snapshot
    assert (refused.judged_version, refused.judged_sha256) == (2, "0" * 64)
    assert (refused.hidden_version, refused.hidden_sha256 != "0" * 64) == (0, True)
    assert (adopted.judged_version, adopted.judged_sha256) == (3, adopted.hidden_sha256)


@pytest.mark.live
def test_a_run_publishes_its_run_info(run: Run) -> None:
    (info, *_) = run.of(topics.RUN_INFO["controller"])
    assert (info.process, info.run_id) == ("controller", run.run_id)
    assert info.config
    statuses = [health.status for health in run.of(topics.HEALTH["controller"])]
    assert [s for k, s in enumerate(statuses) if k == 0 or statuses[k - 1] != s][-2:] == [
        "running",
        "stopping",
    ]
    assert run.counters["ticks"] == len(run.of(topics.TICK))
    assert "Traceback" not in run.said


@pytest.mark.live
def test_a_controller_ends_with_a_frozen_router() -> None:
    config = live_config(*SETTINGS)
    with Process("node_runtime.router", config) as router, Bus(config, "recorder", "recorder-a") as bus:
        ear = BusListener(bus)
        with Process("plant_sim.node", config), Process("controller_node.node", config) as process:
            ear.until(lambda message: isinstance(message, m.Tick))
            router.signal(signal.SIGSTOP)
            process.signal(signal.SIGINT)
            assert process.end() == 0
            assert "Traceback" not in process.said


def test_a_configuration_without_a_controller_gives_a_readable_error(
    caplog: pytest.LogCaptureFixture,
) -> None:
    assert node.main(live_config("controller.phase_ms=40.0")) == 2
    assert (
        "controller.phase_ms = 40.0 is more than 0.5 of a period; at rate = 20.0 Hz at most 25 ms"
        in caplog.text
    )
    assert node.main(live_config('bus.endpoint="nowhere"', "controller.horizon=5")) == 2
    assert "'nowhere' is not an endpoint" in caplog.text
