"""`tandem controller`: the live loop around `ControllerCore`, which latches, steps and publishes."""

from __future__ import annotations

import logging
import os
import threading
import time
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

import msgspec

from controller_node.checkpoint import CheckpointWriter, Snapshot, resume
from controller_node.core import ControllerCore, Outputs
from controller_node.guarantee import guarantee
from controller_node.keyframes import Keyframes
from controller_node.outbox import Outbox
from controller_node.phase import check_phase, phase, with_input_delay
from controller_node.tally import COUNTS, Tally
from node_runtime.bus.inbox import Inbox, Received
from node_runtime.bus.zenoh_bus import Bus
from node_runtime.config.architecture import register_architecture
from node_runtime.config.sections import Config
from node_runtime.health import HealthPublisher
from node_runtime.lifecycle import new_run_id, run_process
from node_runtime.realtime import clock
from node_runtime.realtime.pacer import Grid, Pacer, Slot
from node_runtime.realtime.scheduling import (
    GarbageCollection,
    core_for,
    core_note,
    on_core,
    one_blas_thread,
    punctual,
)
from protocol import codec, topics
from protocol import messages as m

log = logging.getLogger(__name__)

SAMPLES_BATCH = 5
# Longest wait of samples for a batch, in seconds, if that gives larger batches than `SAMPLES_BATCH`.
SAMPLES_WAIT = 0.1
# A state older than this share of a period belongs to an earlier slot.
OLDEST_STATE = 0.8
# Seconds. If all states were too old for this time, the age estimate is reset. No backlog lasts so long, so a clock has
# jumped or the path has become longer. The plant checks the age of commands by its own clock.
FORGIVES_S = 5.0
# Longest wait of a slot for its state, as a share of a period.
STATE_PATIENCE = 0.25
# Seconds. A shorter period has no time for a backup policy, which takes a few milliseconds.
BACKUP_FROM = 0.01


@dataclass(frozen=True, slots=True)
class Latched:
    """The plant's state as found by one slot."""

    verdict: m.StateVerdict
    received: Received[m.PlantState] | None
    age: float
    """Estimated seconds since the sample."""

    @property
    def state(self) -> m.PlantState | None:
        return None if self.received is None else self.received.message


class ControllerNode:
    """One controller on the bus. `run` is its loop; the query thread only reads data that the loop has finished."""

    def __init__(
        self,
        core: ControllerCore,
        bus: Bus,
        health: HealthPublisher,
        counts: dict[str, int],
        outbox: Outbox | None = None,
        checkpoint: CheckpointWriter | None = None,
    ):
        """`counts`: the node's counters, which are updated here. `checkpoint`: None to save no memory."""
        self._core = core
        self._bus = bus
        self._health = health
        self._tally = Tally(counts, health, bus.bad)
        self._settings = core.config.controller
        self._period = core.config.period
        self._phase = phase(core.config)
        # The backup policy feeds back every state of the plant's samples, so all states must be measured.
        self._backs_up = (
            self._settings.backup.enabled
            and self._period >= BACKUP_FROM
            and core.controller.estimator.sees_all
            # With a dead time, feedback with its stiff K may be unstable.
            and not core.plant.dead_time
        )
        core.ready_targets()
        if self._backs_up:
            core.ready_backup()
        self._weights_every = topics.OUTPUT_WEIGHTS.every(self._period)
        self._samples_batch = max(SAMPLES_BATCH, round(SAMPLES_WAIT / self._period))
        self._run_id = core.run_id
        self._states: Inbox[m.PlantState] = Inbox(
            bus, topics.PLANT_STATE, states=core.plant.d, inputs=core.plant.m, sent=lambda state: state.t
        )
        self._trainers: Inbox[m.HiddenWeights] = Inbox(bus, topics.HIDDEN_WEIGHTS, capacity=8)
        self._commanders: Inbox[m.Reference] = Inbox(bus, topics.REFERENCE, capacity=4)
        self._grid = Grid(self._period, clock.now())
        self._first: Received[m.PlantState] | None = None
        self._followed = ""
        self._began: float | None = None
        self._seq = -1
        self._missing = 0
        self._weights: m.HiddenWeights | None = None
        self._reference: m.Reference | None = None
        self._outbox = Outbox(core.run_id) if outbox is None else outbox
        self._checkpoint = checkpoint
        self._unsent: list[m.Sample] = []
        self._hidden = core.memory.hidden_snapshot(-1)
        self._keyframes = Keyframes(bus, core.memory, self._settings.keyframe_every)
        bus.serve(topics.OUTBOX_QUERY, self._outbox.answer)
        bus.serve(topics.HIDDEN_QUERY, self._answer_hidden)

    def run(self, stop: threading.Event) -> None:
        """Run until `stop` is set."""
        pacer = Pacer(self._grid, stop)
        garbage = GarbageCollection.at(self._period)
        garbage.begin()
        if (sets := self._core.certified_sets()) is not None:
            self._bus.publish(topics.SETS, sets)
        self._keyframes.begin()
        while self._find_plant(stop):
            self._keyframes.greet(self._seq, clock.now())
            while self._missing < self._settings.horizon and (turn := pacer.next()) is not None:
                slot, lateness = turn
                latched = self._latch(slot)
                self._tick(slot, lateness, latched)
                self._follow_phase(slot, latched)
                self._take_weights()
                self._take_reference()
                self._keyframes.greet(self._seq, clock.now())
                if self._checkpoint is not None and self._checkpoint.wanted:
                    self._save(self._checkpoint)
                garbage.idle()
        self._send_samples()
        if self._checkpoint is not None and self._seq >= 0:
            self._save(self._checkpoint)
        self._keyframes.send_last(self._seq)

    # -- before the step ---------------------------------------------------------------------------------

    def _find_plant(self, stop: threading.Event) -> bool:
        """Wait for a recent state and put the next slot `phase` after its arrival; return False if told to stop.

        The loop returns here after an outage longer than the plan, because it has nothing left to send.
        """
        if stop.is_set():
            return False
        self._send_samples()
        self._health.set("ready", "no plant: waiting for its states")
        old_since = None
        while not stop.is_set():
            self._first = self._states.wait(0.1)
            if self._first is None:
                old_since = None
                continue
            now = clock.now()
            age = self._states.age(self._first, now)
            if age <= OLDEST_STATE * self._period:
                self._missing = 0
                self._followed = self._first.message.run_id
                self._grid.reanchor(self._states.undelayed(self._first) + self._phase)
                self._health.set("running", self._tally.note)
                return True
            self._health.set("ready", "no plant: its states come too late to act on")
            old_since = now if old_since is None else old_since
            if now - old_since > FORGIVES_S:
                text = "the plant's states have been %.3g s late for %g s; they now count as punctual"
                log.warning(text, age, FORGIVES_S)
                self._states.forget_ages()
        return False

    def _latch(self, slot: Slot) -> Latched:
        """Return the newest state. Wait a little if none of this slot has arrived."""
        received, self._first = self._first or self._states.take(), None
        deadline = slot.time + STATE_PATIENCE * self._period
        oldest = OLDEST_STATE * self._period
        while True:
            now = clock.now()
            age = 0.0 if received is None else self._states.age(received, now)
            if received is not None and age <= oldest:
                return Latched("fresh", received, age)
            newer = self._states.wait(deadline - now) if now < deadline else None
            if newer is None:
                return Latched("missing" if received is None else "stale", received, age)
            received = newer

    def _follow_phase(self, slot: Slot, latched: Latched) -> None:
        """Keep the slots `phase` after the arrival of the plant's states."""
        if latched.verdict != "fresh" or latched.received is None:
            return
        received = latched.received
        arrived = self._states.undelayed(received)
        if received.message.run_id == self._followed:
            self._grid.slew(arrived, self._phase)
            return
        # A new plant process has a new phase.
        self._followed = received.message.run_id
        after = arrived + self._phase + self._period
        self._grid.reanchor(after if after - slot.time > 0.5 * self._period else after + self._period)

    def _take_weights(self) -> None:
        """Decode hidden weights after the step, when there is time. The next tick contains them."""
        for received in self._trainers.take_all():
            weights = received.message
            if weights.for_run != self._run_id:
                detail = f"version {weights.seq} of {weights.run_id} is for {weights.for_run}"
                self._bus.bad.count(topics.HIDDEN_WEIGHTS.name, "for another run", detail)
                continue
            if self._weights is not None:
                detail = f"version {self._weights.seq} by version {weights.seq} of {weights.run_id}"
                self._bus.bad.count(topics.HIDDEN_WEIGHTS.name, "superseded", detail)
            self._weights = weights

    def _take_reference(self) -> None:
        """Take the newest reference for the next tick. If there are several per tick, the older ones are dropped."""
        for received in self._commanders.take_all():
            if self._reference is not None:
                detail = (
                    f"message {self._reference.seq} of {self._reference.run_id} by {received.message.seq}"
                )
                self._bus.bad.count(topics.REFERENCE.name, "superseded", detail)
            self._reference = received.message

    # -- the step and what follows from it ---------------------------------------------------------------

    def _tick(self, slot: Slot, lateness: float, latched: Latched) -> None:
        woken = slot.time + lateness
        self._began = slot.time if self._began is None else self._began
        self._keyframes.remember(self._seq)
        self._seq += 1
        tick = m.Tick(
            run_id=self._run_id,
            seq=self._seq,
            slot=slot.index,
            t=max(0.0, slot.time - self._began),
            skipped=slot.skipped,
            lateness=lateness,
            late=lateness > self._settings.late_fraction * self._period,
            state_verdict=latched.verdict,
            state=latched.state,
            weights=self._weights,
            reference=msgspec.UNSET if self._reference is None else self._reference,
        )
        self._weights = self._reference = None
        outputs = self._core.step(tick)
        self._bus.publish(topics.COMMAND, outputs.command)
        sent = clock.now()
        # The plant refuses commands that answer none of its samples, and their policies. With a distrusted sensor the
        # policy would feed back a wrong measurement.
        obeyed = latched.verdict == "fresh"
        trusted = not outputs.result.sensor_faults
        if (
            self._backs_up
            and obeyed
            and trusted
            and (backup := self._core.backup(outputs.command)) is not None
        ):
            self._bus.publish(topics.BACKUP, backup)
        timing = m.TickTiming(
            run_id=self._run_id,
            seq=self._seq,
            solve_ms=self._core.solve_seconds * 1e3,
            tick_ms=(sent - woken) * 1e3,
            lateness_ms=lateness * 1e3,
            state_age_ms=latched.age * 1e3,
        )
        # Prepare before the bulk thread has work, because it competes for the interpreter.
        self._core.prepare()
        self._bus.publish(topics.TICK, tick)
        self._bus.publish(topics.RESULT, outputs.result)
        self._bus.publish(topics.TIMING, timing)
        self._publish_learning(tick.weights, outputs)
        self._missing = 0 if latched.verdict == "fresh" else self._missing + 1
        self._tally.add(tick, outputs.result, overrun=sent > slot.time + self._period)

    def _publish_learning(self, judged: m.HiddenWeights | None, outputs: Outputs) -> None:
        """Publish everything else of a tick: samples, output weights, keyframes.

        judged: the hidden weights that the tick adopted or refused.
        """
        # Store them before the output weights, which make a trainer ask for them.
        if outputs.new_network or judged is not None:
            self._remember_hidden(judged, outputs.new_network)
        if outputs.sample is not None:
            self._outbox.add(outputs.sample)
            self._unsent.append(outputs.sample)
            if len(self._unsent) >= self._samples_batch:
                self._send_samples()
        due = outputs.new_network or self._seq % self._weights_every == 0
        if due and outputs.output_weights is not None:
            self._bus.publish(topics.OUTPUT_WEIGHTS, outputs.output_weights)
        self._keyframes.send_due(self._seq)

    def _send_samples(self) -> None:
        for batch in self._outbox.batches(self._unsent):
            self._bus.publish(topics.SAMPLES, batch)
        self._unsent = []

    def _save(self, checkpoint: CheckpointWriter) -> None:
        checkpoint.offer(Snapshot(self._seq, self._core.memory.lasting(), dict(self._tally.counts)))

    def _remember_hidden(self, judged: m.HiddenWeights | None, new_network: bool) -> None:
        before = self._hidden
        after = self._core.memory.hidden_snapshot(self._seq) if new_network else before
        if before is None or after is None:
            return
        if judged is None:
            version, sha256 = before.judged_version, before.judged_sha256
        else:
            version, sha256 = judged.seq, judged.sha256
        self._hidden = msgspec.structs.replace(after, judged_version=version, judged_sha256=sha256)

    def _answer_hidden(self, _parameters: dict[str, str]) -> list[bytes]:
        hidden = self._hidden
        return [] if hidden is None else [codec.encode(hidden)]


def main(config: Config, stop: threading.Event | None = None) -> int:
    """Run `tandem controller`. Return 0 when told to stop, 2 for a configuration that allows no controller."""
    with one_blas_thread():
        return run_process(lambda stopping: _live(config, stopping), stop)


def _live(config: Config, stopping: threading.Event) -> int:
    run_id = new_run_id("controller")
    counts = dict.fromkeys(COUNTS, 0)
    check_phase(config)
    config = with_input_delay(config)
    place = core_for(config, "controller", os.sched_getaffinity(0))
    register_architecture(config)
    core = ControllerCore(config, run_id)
    log.info("%s", guarantee(config, core.controller.model, core.sets))
    path = Path(config.controller.checkpoint) if config.controller.checkpoint else None
    before = None if path is None else resume(core.memory, path)
    if before is not None:
        counts |= {name: before.counters.get(name, 0) for name in counts}
    outbox = Outbox(run_id, earlier=() if before is None else before.batches())
    with punctual(config.realtime.priority, keep_awake=config.awake) as note:
        info, standing = core.run_info(time.time()), "; ".join(filter(None, (note, core_note(place))))
        with (
            Bus(config, "controller", run_id, stopping) as bus,
            HealthPublisher(bus, info, lambda: counts, standing) as health,
        ):
            saving = None
            if path is not None:
                belongs = core.memory.belongs()
                saving = CheckpointWriter(path, belongs, outbox, config.trainer.capacity, counts)
            node = ControllerNode(core, bus, health, counts, outbox, saving)
            with saving or nullcontext(), on_core(place):
                node.run(stopping)
    return 0
