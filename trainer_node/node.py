"""The live loop around one plant's `Trainer`: it collects samples, trains when due, and publishes.

It may start before, with or long after the controller, and may be restarted at any time. One query to the controller
returns the hidden layers in use, and another one the samples that were missed.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Executor

import msgspec

from network_model.description import NetworkDescription, hash_layers, why_unacceptable
from node_runtime.bus.inbox import Inbox
from node_runtime.bus.zenoh_bus import Bus
from node_runtime.config.sections import Config, TrainerConfig
from node_runtime.health import HealthPublisher
from node_runtime.realtime import clock
from protocol import codec, topics
from protocol import messages as m
from protocol.topics import Topic
from trainer_node.descent import Descent
from trainer_node.pace import Worth
from trainer_node.questions import SAMPLES_ANSWER, Questions
from trainer_node.training import Draw, Trainer

log = logging.getLogger(__name__)

POLL = 0.02
"""Seconds between two checks for messages."""
JOIN_EVERY = 0.5
"""Minimum seconds between two queries for the hidden layers."""
REFILL_EVERY = 1.0
"""Minimum seconds between two queries for missed samples."""
TRAIN_EVERY = 0.4
"""Minimum seconds between the starts of two trainings. Without it, a fast loop's samples would keep a core busy all the
time, and the loop needs that core."""
SHARE = 0.5
"""Largest share of the time spent on training. A network that is slow to train is trained less often."""
VERDICT_PERIODS, VERDICT_PATIENCE = 3, 0.1
"""Periods, and seconds, after which a controller that has not adopted a set is queried for its decision."""
ADOPTION_PATIENCE = 2.0
"""Seconds after which a set without a decision counts as lost or as displaced by another trainer's set."""
SENT_KNOWN = 64
"""Number of the last sent sets that are recognised in the controller's answers."""
OUTBOX = 20_000
"""Number of samples to query for if the buffer can use more than it holds."""

COUNTERS = (
    "samples",
    "buffer",
    "trainings",
    "published",
    "adopted",
    "not_adopted",
    "rolled_back",
    "others_sets",
    "gaps_filled",
    "joined",
    "samples_of_other_runs",
)
"""Counters of a node, in addition to those of its `Trainer`."""
WAITING = "waiting for a controller with a network"
DISABLED = "trainer.enabled is false: hidden layers are not trained"


Judged = tuple[int, str]
"""Version and SHA-256 of the hidden weights that a controller adopted or refused last."""


class TrainerNode:
    """One plant's trainer on the bus. Everything except waiting for answers happens in the calling thread.

    Args:
        config: the configuration with the plant's name.
        bus: the plant's bus.
        health: publishes the state of this trainer.
        counts: the node's counters, which are updated here; other threads may copy them.
        askers: runs the threads that wait for answers.
    """

    def __init__(
        self, config: Config, bus: Bus, health: HealthPublisher, counts: dict[str, int], askers: Executor
    ):
        self._config = config
        self._bus = bus
        self._questions = Questions(bus, askers)
        self._health = health
        self._counts = counts
        self._patience = max(ADOPTION_PATIENCE, 5 * config.period)
        self._verdict_patience = max(VERDICT_PATIENCE, VERDICT_PERIODS * config.period)
        self._samples: Inbox[m.Samples] = Inbox(bus, topics.SAMPLES, capacity=5000)
        self._outputs: Inbox[m.OutputWeights] = Inbox(bus, topics.OUTPUT_WEIGHTS, capacity=32)
        self._trainer: Trainer | None = None
        self._run = ""
        self._output: m.OutputWeights | None = None
        self._asks = False
        self._join_at = 0.0
        self._gap: int | None = None
        self._refill_at = 0.0
        self._sent_at: float | None = None
        self._explained: deque[Judged] = deque(maxlen=SENT_KNOWN)
        self._train_at = 0.0
        self._waits_since: float | None = None
        self._pays: bool | None = None

    @property
    def settings(self) -> TrainerConfig:
        """The settings of the training, which are equal for all nodes of a process."""
        return self._config.trainer

    @property
    def trainer(self) -> Trainer | None:
        """None until a controller has answered."""
        return self._trainer

    def start(self) -> None:
        """Publish the initial health."""
        self._health.set("ready", WAITING if self._config.trainer.enabled else DISABLED)

    def listen(self, now: float) -> None:
        """Handle all messages, and query for missing data; `now` in seconds on the monotonic clock.

        While a query is open, messages wait, because its answer determines what is missing.
        """
        if not self._config.trainer.enabled:
            return
        answered = self._questions.settle()
        if self._questions.open:
            return
        received = self._outputs.take()
        if received is not None:
            self._follow(received.message, now)
        if self._must_join() and now >= self._join_at and not answered:
            self._join_at = now + JOIN_EVERY
            # Ask the controller that sends K, or any controller before the first K.
            self._questions.ask_hidden(self._joined)
            return
        for batch in self._samples.take_all():
            self._merge(batch.message)
        if self._gap is not None and now >= self._refill_at:
            self._refill_at = now + REFILL_EVERY
            self._refill(self._gap)
        if self._waits_since is None and self._may_train():
            self._waits_since = now

    def update_counters(self) -> None:
        """Update the counters."""
        if self._trainer is not None:
            self._counts.update(self._trainer.counters, buffer=len(self._trainer.buffer))

    def waits_since(self, now: float) -> float | None:
        """Return since when this plant has been ready for training; None if it is not ready."""
        ready = now >= self._train_at and not self._questions.open and self._may_train()
        return self._waits_since if ready else None

    # -- which controller, which hidden layers ---------------------------------------------------------------

    def _follow(self, output: m.OutputWeights, now: float) -> None:
        """Record the newest K, and check whether the controller uses the hidden layers that were sent to it."""
        self._output = output
        if self._trainer is None or output.run_id != self._run:
            return
        if output.hidden_sha256 == self._trainer.sha256:
            if self._sent_at is not None:
                self._count("adopted")
            self._asks, self._sent_at = False, None
            return
        # They were refused, rolled back, not received yet, or displaced by others. The controller knows which.
        under_way = self._sent_at is not None and output.hidden_version < self._trainer.version
        if not under_way or now - (self._sent_at or 0.0) > self._verdict_patience:
            self._asks = True

    def _must_join(self) -> bool:
        """Return whether the hidden layers here may differ from those of the controller that sends K."""
        if self._trainer is None or self._asks:
            return True
        return self._output is not None and self._output.run_id != self._run

    def _joined(self, snapshots: Iterator[m.HiddenSnapshot]) -> None:
        sender = None if self._output is None else self._output.run_id
        for snapshot in snapshots:
            if sender in (None, snapshot.run_id) and self._take_over(snapshot):
                return

    def _take_over(self, snapshot: m.HiddenSnapshot) -> bool:
        """Follow the controller with these hidden layers; return whether they are usable."""
        judged = (snapshot.judged_version, snapshot.judged_sha256)
        followed = self._trainer is not None and snapshot.run_id == self._run
        if followed and not self._is_settled(snapshot, judged):
            return True
        try:
            trainer = self._trainer_from(snapshot)
        except ValueError as error:
            self._bus.bad.count(topics.HIDDEN_QUERY, "unusable", str(error))
            return False
        self._asks, self._sent_at = False, None
        if judged not in self._explained:
            # A decision is evaluated once, no matter which process sent the set.
            self._explained.append(judged)
        if followed and trainer is self._trainer:
            return True
        self._trainer, self._run = trainer, snapshot.run_id
        if self._output is not None and self._output.run_id != self._run:
            self._output = None
        self._gap, self._refill_at = trainer.buffer.last(self._run), 0.0
        self._count("joined")
        log.info("following %s, hidden weights version %d", self._run, snapshot.hidden_version)
        self._health.set("ready", f"following {self._run}")
        return True

    def _is_settled(self, snapshot: m.HiddenSnapshot, judged: Judged) -> bool:
        """Determine why the followed controller uses other hidden layers than those that were sent.

        Returns:
            True to continue from the controller's layers; False if the sent ones are in use now or may still arrive.
        """
        assert self._trainer is not None
        ours, held = self._trainer.version, snapshot.hidden_version
        sent = self._explained[-1] if self._sent_at is not None else None
        if snapshot.hidden_sha256 == self._trainer.sha256:
            # The next K with these layers counts the adoption.
            self._asks = False
            return False
        if held > ours or judged not in self._explained:
            text = "the controller was sent hidden weights version %d by another trainer; it holds version %d"
            log.warning(text, judged[0] if judged not in self._explained else held, held)
            self._count("others_sets")
            # A version that the controller would refuse must not be used.
            self._trainer.leap(judged[0])
        elif sent is None or (judged == sent and held >= ours):
            self._count("rolled_back")
            log.info(
                "the controller rolled back hidden weights version %d; continuing from its present ones", ours
            )
            self._join_at = 0.0
        elif judged == sent:
            self._count("not_adopted")
            log.info(
                "the controller refused hidden weights version %d; continuing from version %d", ours, held
            )
            self._join_at = 0.0
        elif clock.now() - (self._sent_at or 0.0) > self._patience:
            self._count("not_adopted")
            log.warning(
                "there was no decision on hidden weights version %d; continuing from version %d", ours, held
            )
            self._trainer.leap()
        else:
            return False
        return True

    def _trainer_from(self, snapshot: m.HiddenSnapshot) -> Trainer:
        """Return a trainer that continues from these hidden layers, the present one if the network is the same.

        Raises:
            ValueError: the layers are damaged, or not acceptable for their network.
        """
        before, version = self._trainer, max(0, snapshot.hidden_version)
        layers = [layer.numpy().astype(float) for layer in snapshot.layers]
        if hash_layers(layers) != snapshot.hidden_sha256:
            raise ValueError("sha256 does not match the layers")
        description = msgspec.json.decode(snapshot.description, type=NetworkDescription)
        # Check before allocating memory for the layers.
        if (reason := why_unacceptable(description, layers)) is not None:
            raise ValueError(reason)
        if before is not None and before.description == description:
            before.resume(layers, version)
            return before
        config = self._config
        trainer = Trainer(description, config.trainer, config.seed, self._bus.run_id, layers, version)
        if before is not None:
            # The samples of another network are not usable, but versions must keep rising.
            trainer.version = max(trainer.version, before.version)
            trainer.counters.update(before.counters)
        return trainer

    # -- samples ---------------------------------------------------------------------------------------------

    def _merge(self, batch: m.Samples) -> None:
        """Add live samples. If samples before them may be missing, the outbox will be queried."""
        if self._trainer is None or batch.run_id != self._run:
            # These samples are not lost: after the first K of that run, its outbox is queried for all samples.
            self._count("samples_of_other_runs")
            return
        last = self._trainer.buffer.last(self._run)
        # Ticks without a sample leave gaps too, for which the outbox has no more samples.
        if batch.samples and batch.samples[0].seq > last + 1 and self._gap is None:
            self._gap = last
        self._add(topics.SAMPLES, batch)

    def _refill(self, since: int) -> None:
        """Query for all samples after `since`. Without an answer the gap stays and is queried again."""
        if self._trainer is None:
            return
        settings = self._config.trainer
        most = settings.capacity if settings.strategy == "fifo" else OUTBOX
        self._questions.ask_samples(self._run, since, most, lambda batches: self._refilled(batches, since))

    def _refilled(self, batches: Iterator[m.Samples], since: int) -> None:
        assert self._trainer is not None
        new = 0
        for batch in batches:
            if batch.run_id == self._run:
                self._gap = None
            # A restarted controller also keeps samples of its earlier runs.
            new += self._add(SAMPLES_ANSWER, batch)
        if new:
            self._count("gaps_filled")
        if self._trainer.buffer.last(self._run) <= since:
            # Without an answer and without later samples, nothing is known to be missing.
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
        """Return whether training is due and the newest K belongs to the hidden layers to be trained."""
        trainer, output = self._trainer, self._output
        return (
            trainer is not None
            and output is not None
            and not self._must_join()
            and output.hidden_sha256 == trainer.sha256
            and trainer.due(output)
        )

    def begin(self) -> Draw | None:
        """Begin a training; None if the hidden layers are kept. Call it only while `waits_since` returns a time."""
        assert self._trainer is not None
        assert self._output is not None
        self._waits_since = None
        return self._trainer.begin(self._output, self._run)

    def rest(self, now: float, took: float) -> None:
        """Delay the next training after a round that began at `now` and took `took` seconds."""
        self._counts["last_training_ms"] = round(took * 1e3)
        self._train_at = now + max(TRAIN_EVERY, took / SHARE)

    def finish(self, draw: Draw, descent: Descent) -> None:
        """Publish the result of a training if it is an improvement."""
        assert self._trainer is not None
        weights = self._trainer.finish(draw, descent)
        self._report_worth(self._trainer.worth)
        if weights is None:
            return
        self._bus.publish(topics.HIDDEN_WEIGHTS, weights)
        self._sent_at = clock.now()
        self._explained.append((weights.seq, weights.sha256))
        self._count("published")

    def _report_worth(self, worth: Worth | None) -> None:
        """Report the benefit of the last training in health, and in the log if it changed."""
        words = f"following {self._run}" + ("" if worth is None else f"; {worth}")
        pays = None if worth is None else worth.pays
        if worth is not None and pays != self._pays:
            log.info("%s", words)
        self._pays = pays
        self._health.set("running", words)

    def _count(self, name: str) -> None:
        self._counts[name] += 1
