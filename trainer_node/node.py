"""`tandem trainer`: the live shell around `Trainer`. Collect samples, train when due, publish.

It may start before, with or long after the controller, and may be restarted at any time: one query to the
controller gives the hidden layers in force, another one the samples that were missed.
"""

from __future__ import annotations

import logging
import threading
from typing import TypeVar

import msgspec

from node_runtime import clock
from node_runtime.bus import Bus, OpenInterrupted
from node_runtime.config import Config
from node_runtime.health import HealthPublisher, run_info
from node_runtime.inbox import Inbox
from node_runtime.lifecycle import new_run_id, stopped_by_signals
from node_runtime.realtime import quick_handover
from protocol import codec, topics
from protocol import messages as m
from protocol.network import NetworkDescription, hash_layers
from protocol.topics import Topic
from trainer_node.training import Trainer, TrainerError, pick_device, use_one_thread

log = logging.getLogger(__name__)

POLL = 0.02
"""Seconds between two looks at what has arrived."""
ASK_TIMEOUT = 2.0
JOIN_EVERY = 0.5
"""Seconds between two questions for the hidden layers, at least."""
REFILL_EVERY = 1.0
"""Seconds between two questions for missed samples, at least."""
TRAIN_EVERY = 0.4
"""Seconds between the beginnings of two trainings, at least: a fast loop's samples would keep a core busy for good,
and it is the loop that needs it."""
SHARE = 0.5
"""Of the time, at most, is spent training: a network that takes long to train is trained less often."""
ADOPTION_PATIENCE = 2.0
"""Seconds that a controller may go on with other hidden layers than those it was sent."""
OUTBOX = 20_000
"""Samples to ask for when the buffer can make use of more than it holds."""

# An answer is checked like a message of a topic.
HIDDEN_ANSWER = Topic(topics.HIDDEN_QUERY, m.HiddenSnapshot, "bulk", "controller", topics.WEIGHTS_LIMIT)
OUTBOX_ANSWER = Topic(topics.OUTBOX_QUERY, m.Samples, "bulk", "controller", topics.SAMPLES.max_bytes)

_Answer = TypeVar("_Answer", m.HiddenSnapshot, m.Samples)
NAMES = (
    "samples",
    "buffer",
    "trainings",
    "published",
    "adopted",
    "not adopted",
    "gaps filled",
    "joined",
    "samples of other runs",
)
WAITING = "waiting for a controller with a network"


class TrainerNode:
    """One trainer on the bus. Everything happens in the thread that calls `run`."""

    def __init__(self, config: Config, bus: Bus, health: HealthPublisher, counts: dict[str, int]):
        """`counts`: this node's own figures, kept up to date here; other threads may copy it."""
        self._config = config
        self._bus = bus
        self._health = health
        self._counts = counts
        self._patience = max(ADOPTION_PATIENCE, 5 * config.period)
        self._samples: Inbox[m.Samples] = Inbox(bus, topics.SAMPLES, capacity=5000)
        self._outputs: Inbox[m.OutputWeights] = Inbox(bus, topics.OUTPUT_WEIGHTS, capacity=32)
        self._trainer: Trainer | None = None
        self._run = ""
        self._output: m.OutputWeights | None = None
        self._resync = False
        self._join_at = 0.0
        self._gap: int | None = None
        self._refill_at = 0.0
        self._unadopted_since: float | None = None
        self._train_at = 0.0
        self._trained_for = 0.0

    @property
    def trainer(self) -> Trainer | None:
        """None until a controller has answered."""
        return self._trainer

    def run(self, stop: threading.Event) -> None:
        """Until `stop` is set."""
        self._health.set("ready", WAITING)
        while not stop.wait(POLL):
            self.turn(clock.now())

    def turn(self, now: float) -> None:
        """Look at all that has arrived, and do what is due; `now` in seconds on the monotonic clock."""
        received = self._outputs.take()
        if received is not None:
            self._follow(received.message, now)
        if self._must_join() and now >= self._join_at:
            self._join_at = now + JOIN_EVERY
            self._join()
        for batch in self._samples.take_all():
            self._merge(batch.message)
        if self._gap is not None and now >= self._refill_at:
            self._refill_at = now + REFILL_EVERY
            self._refill(self._gap)
        if now >= self._train_at and self._may_train():
            self._train()
            self._train_at = now + max(TRAIN_EVERY, self._trained_for / SHARE)
        if self._trainer is not None:
            self._counts.update(self._trainer.counters, buffer=len(self._trainer.buffer))

    # -- which controller, which hidden layers ---------------------------------------------------------------

    def _follow(self, output: m.OutputWeights, now: float) -> None:
        """Take note of the newest K, and of whether the controller holds the hidden layers it was sent."""
        self._output = output
        if self._trainer is None or output.run_id != self._run:
            return
        if output.hidden_sha256 == self._trainer.sha256:
            if self._unadopted_since is not None:
                self._count("adopted")
            self._unadopted_since = None
        elif self._unadopted_since is None:
            self._unadopted_since = now
        elif now - self._unadopted_since > self._patience and not self._resync:
            # Refused, lost on the way, or another trainer's were adopted: what the controller holds is right.
            self._count("not adopted")
            log.warning(
                "the controller still holds hidden weights version %d and not %d; going on from its own",
                output.hidden_version,
                self._trainer.version,
            )
            self._resync = True

    def _must_join(self) -> bool:
        """Whether the hidden layers here are not, or may not be, those of the controller that sends K."""
        if self._trainer is None or self._resync:
            return True
        return self._output is not None and self._output.run_id != self._run

    def _join(self) -> None:
        """Take over the hidden layers of the controller that sends K; before that, of any that answers."""
        sender = None if self._output is None else self._output.run_id
        for payload in self._bus.ask(topics.HIDDEN_QUERY, {}, ASK_TIMEOUT):
            snapshot = self._decode(HIDDEN_ANSWER, payload, m.HiddenSnapshot)
            if snapshot is not None and sender in (None, snapshot.run_id) and self._take_over(snapshot):
                return

    def _take_over(self, snapshot: m.HiddenSnapshot) -> bool:
        trainer, version = self._trainer, max(0, snapshot.hidden_version)
        layers = [layer.numpy().astype(float) for layer in snapshot.layers]
        try:
            if hash_layers(layers) != snapshot.hidden_sha256:
                raise ValueError("sha256 does not match the layers")
            description = msgspec.json.decode(snapshot.description, type=NetworkDescription)
            if trainer is not None and trainer.description == description:
                trainer.resume(layers, version)
            else:
                config, run_id = self._config, self._bus.run_id
                before, trainer = (
                    trainer,
                    Trainer(description, config.trainer, config.seed, run_id, layers, version),
                )
                if before is not None:
                    # Samples of another network's plant are of no use, but versions go on rising.
                    trainer.version = max(trainer.version, before.version)
                    trainer.counters.update(before.counters)
        except ValueError as error:
            self._bus.bad.count(topics.HIDDEN_QUERY, "unusable", str(error))
            return False
        self._trainer, self._run = trainer, snapshot.run_id
        if self._output is not None and self._output.run_id != self._run:
            self._output = None
        self._resync, self._unadopted_since = False, None
        self._gap, self._refill_at = trainer.buffer.last(self._run), 0.0
        self._count("joined")
        log.info("following %s, hidden weights version %d", self._run, snapshot.hidden_version)
        self._health.set("ready", f"following {self._run}")
        return True

    # -- samples ---------------------------------------------------------------------------------------------

    def _merge(self, batch: m.Samples) -> None:
        """Add live samples. Where one may have been lost before them, the outbox will be asked."""
        if self._trainer is None or batch.run_id != self._run:
            # Not lost: once that run's K has come, joining it asks its outbox for all of them.
            self._count("samples of other runs")
            return
        last = self._trainer.buffer.last(self._run)
        # Ticks that the controller missed leave gaps too; then the outbox has nothing more either.
        if batch.samples and batch.samples[0].seq > last + 1 and self._gap is None:
            self._gap = last
        self._add(topics.SAMPLES, batch)

    def _refill(self, since: int) -> None:
        """Ask for all samples after `since`. Without an answer the gap stays, and is asked for again."""
        if self._trainer is None:
            return
        settings = self._config.trainer
        last = settings.capacity if settings.strategy == "fifo" else OUTBOX
        parameters = {"run": self._run, "since": str(since), "last": str(last)}
        new = 0
        for payload in self._bus.ask(topics.OUTBOX_QUERY, parameters, ASK_TIMEOUT):
            batch = self._decode(OUTBOX_ANSWER, payload, m.Samples)
            if batch is not None and batch.run_id == self._run:
                self._gap = None
                new += self._add(OUTBOX_ANSWER, batch)
        if new:
            self._count("gaps filled")
        if self._trainer.buffer.last(self._run) <= since:
            # No answer, but nothing came after the gap either: nothing is known to be missing.
            self._gap = None

    def _add(self, topic: Topic, batch: m.Samples) -> int:
        assert self._trainer is not None
        description = self._trainer.description
        try:
            codec.check_dimensions(topic, batch, description.states, description.inputs)
        except codec.BadMessage as error:
            self._bus.bad.count(error.topic, error.reason, error.detail)
            return 0
        return self._trainer.add(batch.run_id, batch.samples)

    # -- training --------------------------------------------------------------------------------------------

    def _may_train(self) -> bool:
        """Whether it is time, and the newest K belongs to the hidden layers that would be trained."""
        trainer, output = self._trainer, self._output
        return (
            trainer is not None
            and output is not None
            and not self._must_join()
            and output.hidden_sha256 == trainer.sha256
            and trainer.due()
        )

    def _train(self) -> None:
        assert self._trainer is not None
        assert self._output is not None
        began = clock.now()
        weights = self._trainer.train(self._output, self._run)
        self._trained_for = clock.now() - began
        self._counts["last training, ms"] = round(self._trained_for * 1e3)
        if weights is None:
            return
        self._bus.publish(topics.HIDDEN_WEIGHTS, weights)
        self._unadopted_since = clock.now()
        self._count("published")
        self._health.set("running", f"following {self._run}")

    def _decode(self, topic: Topic, payload: bytes, kind: type[_Answer]) -> _Answer | None:
        try:
            answer = codec.decode(topic, payload)
        except codec.BadMessage as error:
            self._bus.bad.count(error.topic, error.reason, error.detail)
            return None
        assert isinstance(answer, kind)
        return answer

    def _count(self, name: str) -> None:
        self._counts[name] += 1


def main(config: Config, stop: threading.Event | None = None) -> int:
    """`tandem trainer`. 0 when told to stop, 2 when this machine cannot train as configured."""
    try:
        pick_device(config.trainer.device)
    except TrainerError as error:
        log.error("%s", error)
        return 2
    use_one_thread()
    run_id = new_run_id("trainer")
    counts = dict.fromkeys(NAMES, 0)
    with stopped_by_signals(stop) as stopping, quick_handover():
        try:
            with (
                Bus(config, "trainer", run_id, stopping) as bus,
                HealthPublisher(bus, run_info(config, "trainer", run_id), counts.copy) as health,
            ):
                if config.trainer.enabled:
                    TrainerNode(config, bus, health, counts).run(stopping)
                else:
                    health.set("ready", "trainer.enabled is false: hidden layers are not trained")
                    stopping.wait()
        except OpenInterrupted:
            log.info("stopped before there was a router")
    return 0
