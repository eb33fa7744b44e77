"""A trainer in a thread of the test, and a controller that consists only of its messages."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack

import msgspec
import numpy as np

from controller_node.outbox import Outbox
from network_model.description import NetworkDescription, hash_layers, initial_hidden
from node_runtime.bus.inbox import Inbox
from node_runtime.bus.zenoh_bus import Bus
from node_runtime.config.sections import Config, TrainerConfig
from node_runtime.health import HealthPublisher
from node_runtime.provenance import run_info
from node_runtime.realtime import clock
from protocol import codec, topics
from protocol.messages import Array, Health, HiddenSnapshot, HiddenWeights, OutputWeights, Sample, Samples
from trainer_node import node as trainer_module
from trainer_node.node import COUNTERS, TrainerNode
from trainer_node.training_round import train_round

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


class Controller:
    """Sends a controller's messages, one `tick` at a time, and adopts received weights unless told otherwise."""

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
        """Roll back, without changing the highest version."""
        self.hidden = [layer.astype(np.float32).astype(float) for layer in hidden]

    def tick(self, times: int = 1, lost: bool = False, miss: int = 0) -> None:
        """Send samples whose h identifies them, and K. `lost`: they do not arrive. `miss`: skipped ticks."""
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
        """Wait for a trainer's health that satisfies the condition; `ignored` is another trainer's run id."""
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
    """A trainer in a thread of this process whose internals a test can read."""

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
        """Return the sequence numbers of all samples in the buffer, ascending."""
        assert self.node.trainer is not None
        return sorted(round(h * 1e6) for h in self.node.trainer.buffer.contents()[1][:, 0])


def joined(health: Health) -> bool:
    return health.counters.get("joined", 0) > 0


def holds(samples: int) -> Callable[[Health], bool]:
    return lambda health: health.counters.get("samples", 0) == samples
