"""The trainer on a real bus, beside a controller that is only its messages: join, restart, lose, refuse."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import time
import tracemalloc
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack

import msgspec
import numpy as np
import pytest
import zenoh

from controller_node.outbox import Outbox
from network_model.description import LAYERS, NetworkDescription, hash_layers, initial_hidden
from node_runtime.bus.inbox import Inbox
from node_runtime.bus.zenoh_bus import Bus, session_config
from node_runtime.config.loading import to_json
from node_runtime.config.sections import BusConfig, Config, TrainerConfig
from node_runtime.health import HealthPublisher
from node_runtime.provenance import run_info
from node_runtime.realtime import clock
from node_runtime.router import open_router
from protocol import codec, topics
from protocol.messages import Array, Health, HiddenSnapshot, HiddenWeights, OutputWeights, Sample, Samples
from tests.helpers.live import PROGRAM
from trainer_node import node as trainer_module
from trainer_node.main import main
from trainer_node.node import COUNTERS, TrainerNode
from trainer_node.training_round import train_round

pytestmark = pytest.mark.live

DESCRIPTION = NetworkDescription(
    states=2,
    inputs=1,
    hidden=[8],
    activations=["tanh"],
    input_scale=[1.0, 1.0, 1.0],
    output_scale=[0.01, 0.01],
)
TRAINING = TrainerConfig(capacity=5000, train_every=20, min_samples=20, batch=64, steps=10, device="cpu")
PATIENCE = 60.0


@pytest.fixture
def config() -> Iterator[Config]:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    config = Config(trainer=TRAINING, bus=BusConfig(endpoint=f"tcp/127.0.0.1:{port}", follow_silence=0.2))
    with open_router(config):
        yield config


class Controller:
    """Says what a controller says, one `tick` at a time, and adopts what it is sent unless told otherwise."""

    def __init__(
        self, config: Config, run_id: str, seed: int = 0, description: NetworkDescription = DESCRIPTION
    ):
        self.config = config
        self.run_id = run_id
        self.description = description
        self.hidden = initial_hidden(description, np.random.default_rng(seed))
        self.version, self.heard = 0, -1
        self.adopts, self.judges = True, True
        self.judged = (-1, "")
        self.claimed = ""
        self.adopted: list[HiddenWeights] = []
        self.questions: list[float] = []
        self.seq = -1
        self._outbox = Outbox(run_id)
        self.bus = Bus(config, "controller", run_id)

    def __enter__(self) -> Controller:
        self.bus.open()
        self._weights: Inbox[HiddenWeights] = Inbox(self.bus, topics.HIDDEN_WEIGHTS)
        self._health = self.bus.queue(topics.HEALTH["trainer"])
        self.bus.serve(topics.HIDDEN_QUERY, lambda _: [codec.encode(self.snapshot())])
        self.bus.serve(topics.OUTBOX_QUERY, self._answer)
        return self

    def __exit__(self, *_: object) -> None:
        self.bus.close()

    def _answer(self, parameters: dict[str, str]) -> list[bytes]:
        self.questions.append(time.monotonic())
        return self._outbox.answer(parameters)

    def snapshot(self) -> HiddenSnapshot:
        return HiddenSnapshot(
            run_id=self.run_id,
            seq=max(self.seq, 0),
            hidden_version=self.version,
            hidden_sha256=self.claimed or hash_layers(self.hidden),
            description=msgspec.json.encode(self.description).decode(),
            layers=[Array.of(layer, "<f4") for layer in self.hidden],
            judged_version=self.judged[0],
            judged_sha256=self.judged[1],
        )

    def roll_back(self, hidden: list[np.ndarray]) -> None:
        """The highest version stays what it was."""
        self.hidden = [layer.astype(np.float32).astype(float) for layer in hidden]

    def tick(self, times: int = 1, lost: bool = False, miss: int = 0) -> None:
        """Samples whose h tells which it is, and K. `lost`: they do not arrive. `miss`: ticks left out."""
        self.seq += miss
        batch = []
        for _ in range(times):
            self.seq += 1
            x = np.random.default_rng([7, self.seq]).uniform(-1, 1, self.description.states)
            label = [1e-6 * self.seq] * self.description.states
            batch.append(Sample(seq=self.seq, x=x.tolist(), u=[0.5], h=label))
            self._outbox.add(batch[-1])
        if not lost:
            self.bus.publish(topics.SAMPLES, Samples(run_id=self.run_id, seq=self.seq, samples=batch))
        received = self._weights.take()
        self.heard = max(self.heard, received.message.seq if received else -1)
        if received is not None and self.judges:
            self.judged = (received.message.seq, received.message.sha256)
        if self.adopts and received is not None and received.message.seq > self.version:
            self.adopted.append(received.message)
            self.version = received.message.seq
            self.hidden = [layer.numpy().astype(float) for layer in received.message.layers]
        K = 0.1 * np.random.default_rng(self.seq).normal(
            size=(self.description.features, self.description.states)
        )
        self.bus.publish(
            topics.OUTPUT_WEIGHTS,
            OutputWeights(
                run_id=self.run_id,
                seq=self.seq,
                hidden_version=self.version,
                hidden_sha256=hash_layers(self.hidden),
                K=Array.of(K),
            ),
        )

    def until(self, condition: Callable[[Health], bool], tick: bool = False, ignored: str = "") -> Health:
        """Wait for a trainer's health that satisfies the condition; `ignored`: another trainer's run id."""
        deadline = time.monotonic() + PATIENCE
        health = None
        while time.monotonic() < deadline:
            delivery = self._health.get(0.2)
            if delivery is not None:
                health = codec.decode_as(Health, delivery.payload)
                if health.run_id != ignored and condition(health):
                    return health
            if tick:
                self.tick(5)
        raise AssertionError(f"the trainer's last health was {health}")


class RunningTrainer:
    """A trainer in a thread of this process, with its inside open to a test."""

    def __init__(self, config: Config, run_id: str = "trainer-1"):
        self.stop = threading.Event()
        self._stack = ExitStack()
        bus = self._stack.enter_context(Bus(config, "trainer", run_id))
        counts = dict.fromkeys(COUNTERS, 0)
        health = self._stack.enter_context(
            HealthPublisher(bus, run_info(config, "trainer", run_id), counts.copy)
        )
        askers = self._stack.enter_context(ThreadPoolExecutor(1))
        self.node = TrainerNode(config, bus, health, counts, askers)
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> RunningTrainer:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop.set()
        self._thread.join(PATIENCE)
        self._stack.close()

    def _run(self) -> None:
        self.node.start()
        while not self.stop.wait(trainer_module.POLL):
            now = clock.now()
            self.node.listen(now)
            train_round([self.node], now)
            self.node.update_counters()

    def labels(self) -> list[int]:
        """Sequence numbers of all that is in the buffer, ascending."""
        assert self.node.trainer is not None
        return sorted(round(h * 1e6) for h in self.node.trainer.buffer.contents()[1][:, 0])


def joined(health: Health) -> bool:
    return health.counters.get("joined", 0) > 0


def holds(samples: int) -> Callable[[Health], bool]:
    return lambda health: health.counters.get("samples", 0) == samples


def test_it_trains_and_the_controller_adopts_again_and_again(config: Config) -> None:
    with Controller(config, "controller-1") as controller, RunningTrainer(config) as trainer:
        controller.until(lambda h: h.counters.get("adopted", 0) >= 3, tick=True)
        first, second = controller.adopted[:2]
        assert (first.for_run, first.seq) == ("controller-1", 1)
        assert second.base_sha256 == first.sha256
        assert second.trained_on > first.trained_on
        assert second.loss_after < second.loss_before
        controller.until(holds(controller.seq + 1))
        assert trainer.labels() == list(range(controller.seq + 1))


def test_a_late_trainer_gets_the_samples_it_missed_once_each(config: Config) -> None:
    with Controller(config, "controller-1") as controller:
        for _ in range(60):
            controller.tick(20)
        with RunningTrainer(config) as trainer:
            # Live samples go on arriving while the old ones are fetched.
            controller.until(joined, tick=True)
            controller.until(holds(controller.seq + 1))
            assert trainer.labels() == list(range(controller.seq + 1))


def test_a_trainer_may_come_before_the_controller_and_before_the_first_tick(config: Config) -> None:
    with RunningTrainer(config) as trainer, Controller(config, "controller-1") as controller:
        controller.until(joined)
        controller.until(lambda h: h.counters["adopted"] >= 1, tick=True)
        controller.until(holds(controller.seq + 1))
        assert trainer.labels() == list(range(controller.seq + 1))


def test_a_restarted_trainer_goes_on_with_rising_versions(config: Config) -> None:
    with Controller(config, "controller-1") as controller:
        with RunningTrainer(config):
            controller.until(lambda h: h.counters["adopted"] >= 2, tick=True)
        reached = controller.version
        with RunningTrainer(config, "trainer-2") as trainer:
            controller.until(lambda h: h.counters.get("adopted", 0) >= 1, tick=True, ignored="trainer-1")
            assert controller.adopted[-1].run_id == "trainer-2"
            assert controller.adopted[-1].seq > reached
            health = controller.until(holds(controller.seq + 1), ignored="trainer-1")
            assert health.counters["not adopted"] == 0
            assert trainer.labels() == list(range(controller.seq + 1))


def test_lost_samples_are_fetched_and_missed_ticks_are_not_asked_for_again(config: Config) -> None:
    with Controller(config, "controller-1") as controller, RunningTrainer(config) as trainer:
        controller.until(joined)
        controller.tick(10)
        controller.until(holds(10))
        asked = len(controller.questions)
        controller.tick(10, lost=True)
        controller.tick(10)
        health = controller.until(holds(30))
        assert health.counters["gaps filled"] >= 1
        assert trainer.labels() == list(range(30))
        assert len(controller.questions) == asked + 1
        # Ticks that never were look the same; their question is settled by its answer, and asked at most once
        # a second.
        for _ in range(5):
            controller.tick(1, miss=2)
            controller.tick(1, miss=2)
        controller.until(holds(40))
        # They are stamped where they arrive; asked at every gap they would be a tick apart.
        assert np.diff(controller.questions).min() > 0.5 * trainer_module.REFILL_EVERY
        expected = [*range(30), *(29 + 3 * made for made in range(1, 11))]
        assert trainer.labels() == expected


def test_a_restarted_controller_is_followed_and_its_predecessors_samples_stay(config: Config) -> None:
    with RunningTrainer(config) as trainer:
        with Controller(config, "controller-1") as controller:
            controller.until(lambda h: h.counters["adopted"] >= 2, tick=True)
            controller.until(holds(controller.seq + 1))
            before, version = controller.seq + 1, controller.version
        with Controller(config, "controller-2", seed=1) as controller:
            joins = controller.until(joined).counters["joined"]
            base = hash_layers(controller.hidden)
            controller.until(lambda h: h.counters["joined"] > joins and h.counters["adopted"] >= 3, tick=True)
            assert controller.adopted[0].for_run == "controller-2"
            assert controller.adopted[0].base_sha256 == base
            assert controller.adopted[0].seq > version
            controller.until(holds(before + controller.seq + 1))
            assert trainer.labels() == sorted([*range(before), *range(controller.seq + 1)])


def test_a_controller_that_refuses_is_asked_what_it_holds(
    config: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trainer_module, "ADOPTION_PATIENCE", 2 * PATIENCE)
    with Controller(config, "controller-1") as controller, RunningTrainer(config):
        controller.adopts = False
        controller.until(lambda h: h.counters["not adopted"] >= 1, tick=True)
        base = hash_layers(controller.hidden)
        controller.adopts = True
        controller.until(lambda h: h.counters["adopted"] >= 1, tick=True)
        assert controller.adopted[0].base_sha256 == base
        assert controller.adopted[0].seq >= 2


def test_after_every_refusal_training_goes_on_from_what_is_in_use(
    config: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trainer_module, "ADOPTION_PATIENCE", 2 * PATIENCE)
    with Controller(config, "controller-1") as controller, RunningTrainer(config):
        for refused in range(1, 4):
            controller.adopts = False
            controller.until(lambda h, n=refused: h.counters["not adopted"] >= n, tick=True)  # type: ignore[misc]
            controller.adopts = True
            done = len(controller.adopted)
            health = controller.until(lambda _, n=done: len(controller.adopted) > n, tick=True)  # type: ignore[misc]
        bases = [hash_layers(initial_hidden(DESCRIPTION, np.random.default_rng(0)))]
        bases += [weights.sha256 for weights in controller.adopted]
        assert [weights.base_sha256 for weights in controller.adopted] == bases[:-1]
        # Not one version was left out, and nobody was suspected.
        assert controller.heard <= health.counters["published"] + 1
        assert health.counters["others' sets"] == 0


@pytest.mark.parametrize("joined_before", [True, False], ids=["its own", "from before it came"])
def test_after_a_rollback_training_goes_on_at_once_with_the_next_version(
    config: Config, monkeypatch: pytest.MonkeyPatch, joined_before: bool
) -> None:
    monkeypatch.setattr(trainer_module, "ADOPTION_PATIENCE", 2 * PATIENCE)
    with Controller(config, "controller-1") as controller, RunningTrainer(config):
        first = controller.hidden
        controller.until(lambda _: len(controller.adopted) >= 2, tick=True)
        controller.until(lambda h: h.counters["adopted"] >= len(controller.adopted), tick=True)
        before = [layer.numpy().astype(float) for layer in controller.adopted[-2].layers]
        # What this trainer may never have seen is known by what was judged last.
        controller.roll_back(before if joined_before else [1.01 * layer for layer in first])
        back, newest = controller.snapshot().hidden_sha256, controller.version
        controller.until(lambda _: controller.version > newest, tick=True)
        assert controller.adopted[-1].seq == newest + 1
        assert controller.adopted[-1].base_sha256 == back
        health = controller.until(lambda h: h.counters["rolled back"] >= 1)
        assert (health.counters["others' sets"], health.counters["not adopted"]) == (0, 0)


@pytest.mark.parametrize(
    ("patience", "lead", "judged"),
    [(2 * PATIENCE, 0, True), (2 * PATIENCE, 400, True), (0.3, 400, False)],
    ids=["adopted", "refused", "heard"],
)
def test_a_thief_under_its_name_does_not_silence_a_trainer(
    config: Config, monkeypatch: pytest.MonkeyPatch, patience: float, lead: int, judged: bool
) -> None:
    """A stranger's sets are judged, which is known at once; or one is only heard, and versions must pass it."""
    monkeypatch.setattr(trainer_module, "ADOPTION_PATIENCE", patience)
    patient = msgspec.structs.replace(
        config, bus=msgspec.structs.replace(config.bus, follow_silence=2 * PATIENCE)
    )
    rng = np.random.default_rng(3)
    with (
        Controller(patient, "controller-1") as controller,
        RunningTrainer(config, "trainer-1"),
        Bus(config, "monitor", "thief") as thief,
    ):
        forged: list[str] = []

        def steal(lead: int) -> None:
            layers = [layer + 0.1 * rng.standard_normal(layer.shape) for layer in controller.hidden]
            packed = [Array.of(layer, "<f4") for layer in layers]
            forged.append(hash_layers([array.numpy() for array in packed]))
            weights = msgspec.structs.replace(
                controller.adopted[-1],
                seq=controller.adopted[-1].seq + lead,
                sha256=forged[-1],
                layers=packed,
            )
            thief.publish(topics.HIDDEN_WEIGHTS, weights)

        def in_use() -> str:
            return controller.adopted[-1].sha256 if controller.adopted else ""

        def stolen(_: Health) -> bool:
            # Again and again: what the trainer sent meanwhile is ahead of it.
            if in_use() not in forged:
                steal(5)
            return in_use() in forged

        for _ in range(3):
            controller.until(lambda _: in_use() not in ("", *forged), tick=True)
            controller.until(stolen, tick=True)
            if lead:
                controller.adopts, controller.judges = False, judged
                steal(lead)
                controller.until(lambda _: controller.heard >= controller.adopted[-1].seq + lead, tick=True)
                controller.adopts = controller.judges = True
        controller.until(lambda _: in_use() not in forged, tick=True)


def test_another_network_begins_anew(config: Config) -> None:
    other = msgspec.structs.replace(DESCRIPTION, states=3, input_scale=[1.0] * 4, output_scale=[0.01] * 3)
    with RunningTrainer(config) as trainer:
        with Controller(config, "controller-1") as controller:
            controller.until(lambda h: h.counters["adopted"] >= 1, tick=True)
            version = controller.version
        with Controller(config, "controller-2", description=other) as controller:
            controller.until(lambda h: bool(controller.adopted), tick=True)
            assert controller.adopted[0].seq > version
            assert trainer.node.trainer is not None
            assert trainer.node.trainer.description == other


def test_bad_messages_are_counted_and_stop_nothing(config: Config) -> None:
    # The stranger must stay one, however slow this machine is.
    config = msgspec.structs.replace(config, bus=msgspec.structs.replace(config.bus, follow_silence=60.0))
    with Controller(config, "controller-1") as controller, RunningTrainer(config) as trainer:
        controller.until(joined)
        stranger = zenoh.open(session_config("client", config.bus.endpoint, config.bus.lease_ms))
        for topic in (topics.SAMPLES, topics.OUTPUT_WEIGHTS):
            for payload in (b"", b"\xc1" * 40, os.urandom(200)):
                stranger.put(topic.key(config.name), payload)
        controller.tick(5)
        nan = Sample(seq=9, x=[float("nan"), 0.0], u=[0.0], h=[0.0, 0.0])
        long = Sample(seq=9, x=[0.0] * 3, u=[0.0], h=[0.0, 0.0])
        foreign = Sample(seq=9, x=[0.0] * 2, u=[0.0], h=[0.0, 0.0])
        for run, sample in (("controller-1", nan), ("someone", foreign), ("controller-1", long)):
            controller.bus.publish(topics.SAMPLES, Samples(run_id=run, seq=5, samples=[sample]))
        controller.bus.publish(
            topics.OUTPUT_WEIGHTS,
            OutputWeights(
                run_id="controller-1",
                seq=5,
                hidden_version=0,
                hidden_sha256=hash_layers(controller.hidden),
                K=Array.of(np.zeros((3, 7))),
            ),
        )
        controller.seq = 5
        health = controller.until(lambda h: h.counters["adopted"] >= 1, tick=True)
        stranger.close()
        for key in (
            "bad controller/samples: malformed",
            "bad controller/output_weights: malformed",
            "bad controller/samples: not finite",
            "bad controller/samples: wrong size",
            "bad controller/samples: foreign",
        ):
            assert health.counters.get(key, 0) >= 1, (key, health.counters)
        controller.until(holds(controller.seq))
        assert trainer.labels() == [*range(5), *range(6, controller.seq + 1)]


def test_a_snapshot_that_cannot_be_right_is_not_used(config: Config) -> None:
    with Controller(config, "controller-1") as controller, RunningTrainer(config) as trainer:
        right = controller.hidden
        controller.hidden = [np.full_like(layer, np.inf) for layer in right]
        bad = "bad controller/hidden: not finite"
        controller.until(lambda h: h.counters.get(bad, 0) >= 1)
        controller.hidden = right[::-1] * 2
        bad = "bad controller/hidden: unusable"
        before = controller.until(lambda h: h.counters.get(bad, 0) >= 1).counters[bad]
        controller.hidden, controller.claimed = right, "0" * 64
        controller.until(lambda h: h.counters[bad] >= before + 2)
        assert trainer.node.trainer is None
        controller.claimed = ""
        controller.until(joined)


def test_a_network_that_nobody_could_hold_takes_no_memory(config: Config) -> None:
    """A stolen controller's certificate must not end the trainer of all plants."""
    with Controller(config, "controller-1") as controller, RunningTrainer(config) as trainer:
        huge = msgspec.structs.replace(
            controller.description, hidden=[4096] * LAYERS, activations=["tanh"] * LAYERS
        )
        controller.description = huge
        tracemalloc.start()
        try:
            controller.until(lambda h: h.counters.get("bad controller/hidden: unusable", 0) >= 1)
            assert tracemalloc.get_traced_memory()[1] < 2**28
        finally:
            tracemalloc.stop()
        assert trainer.node.trainer is None


def process(config: Config) -> subprocess.Popen[bytes]:
    program = PROGRAM.format(module="trainer_node.main")
    return subprocess.Popen([sys.executable, "-c", program, to_json(config)])


def test_a_killed_process_is_replaced_and_its_successor_ends_when_asked(config: Config) -> None:
    with Controller(config, "controller-1") as controller:
        first = process(config)
        try:
            health = controller.until(lambda h: h.counters["adopted"] >= 1, tick=True)
        finally:
            first.kill()
            first.wait(PATIENCE)
        controller.tick(40)
        second = process(config)
        try:
            controller.until(lambda h: h.counters["adopted"] >= 1, tick=True, ignored=health.run_id)
            last = controller.until(holds(controller.seq + 1), ignored=health.run_id)
            assert last.counters["buffer"] == controller.seq + 1
            second.send_signal(signal.SIGTERM)
            assert second.wait(PATIENCE) == 0
        finally:
            second.kill()
            second.wait(PATIENCE)


def test_it_stops_while_there_is_no_router() -> None:
    config = Config(trainer=TRAINING, bus=BusConfig(endpoint="tcp/127.0.0.1:9"))
    stop = threading.Event()
    codes: list[int] = []
    thread = threading.Thread(target=lambda: codes.append(main(config, stop)))
    thread.start()
    stop.set()
    thread.join(PATIENCE)
    assert codes == [0]


def test_hidden_layers_that_are_not_to_be_trained_are_left_alone(config: Config) -> None:
    config = msgspec.structs.replace(config, trainer=msgspec.structs.replace(TRAINING, enabled=False))
    stop = threading.Event()
    thread = threading.Thread(target=main, args=[config, stop])
    with Controller(config, "controller-1") as controller:
        thread.start()
        controller.until(lambda h: "trainer.enabled" in h.note)
        stop.set()
        thread.join(PATIENCE)
    assert not controller.adopted
