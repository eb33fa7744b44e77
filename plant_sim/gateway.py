"""The gateway: connects a machine to the bus by two functions, and provides all that a controller expects of a plant.

The complete program for a compressor:

    import numpy as np
    from plant_sim import Gateway

    def read() -> np.ndarray:
        return np.array([rig.flow(), rig.pressure(), rig.throttle(), rig.throttle_speed()])

    def write(u: np.ndarray) -> None:
        rig.set_throttle(u[0])

    Gateway(None, "tandem.toml").serve(read, write)
"""

from __future__ import annotations

import logging
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path

from lbmpc.plants import Known, Plant, PlantError, get_plant
from node_runtime.bus.inbox import Inbox
from node_runtime.bus.session import OpenInterrupted
from node_runtime.bus.zenoh_bus import Bus
from node_runtime.config.loading import load
from node_runtime.config.plant import plant_of
from node_runtime.config.sections import Config
from node_runtime.health import HealthPublisher
from node_runtime.lifecycle import new_run_id, stopped_by_signals
from node_runtime.provenance import run_info
from node_runtime.realtime import clock
from node_runtime.realtime.pacer import Grid, Pacer, Slot
from node_runtime.realtime.scheduling import GarbageCollection, core_for, core_note, on_core, punctual
from plant_sim.hand import NO_LONGER
from plant_sim.machine import Guarded, Read, Write
from plant_sim.shield import Shield
from plant_sim.way_back import way_back_of
from protocol import topics
from protocol.messages import Backup, Command, InputSource, Override, ProcessStatus

log = logging.getLogger(__name__)

LATE = 0.2
"""Share of a period after which a sample counts as late."""
STRETCH = 0.01
"""Share of a period before the next sample in which the loop sleeps instead of waiting for messages."""
LONGEST_WAIT_S = 0.1
"""Longest wait of the loop, after which it notices a request to stop."""
NOTES: dict[InputSource, str] = {
    "hold": "held at x0 until the first command",
    "command": "",
    "plan": "no fresh command: following the backup policy, or the last plan",
    "safe": "no fresh command and nothing left to follow: safe input",
    "manual": "under manual control",
}
BEFORE_COMMANDS = "safe input until the first command"


class Gateway:
    """A plant on the bus, made of two functions.

    At every sampling time the state is read and published. A command acts from its arrival. A command from a foreign
    sender, a stale one, or one for another period is refused and counted. Without commands the backup policy acts,
    then the plan, then the safe input (`plant_sim.shield`). The safe input also acts before the first command and at
    the end. An input that a person commands by hand has precedence while the plant stays in X (`plant_sim.hand`).

    Args:
        known: the description of the plant: dimensions, bounds and safe input. None for the plant named by `config`.
        config: the resolved configuration, or its file.
        simulated: True if the functions are a simulation's. It stands still until the first `write`, and each call
            counts as made at its `due` time, even if a busy computer made it later.

    Raises:
        ConfigError: the configuration is wrong or does not fit the plant.
    """

    def __init__(self, known: Known | Plant | None, config: Config | Path | str, *, simulated: bool = False):
        self.config = config if isinstance(config, Config) else load(config)
        self.known = plant_of(self.config, get_plant, known)
        self._way_back = way_back_of(self.config, self.known)
        self._simulated = simulated
        self._serving: tuple[Shield, Guarded] | None = None

    @property
    def due(self) -> float:
        """The time for which the present call is made, in seconds on the monotonic clock."""
        return 0.0 if self._serving is None else self._serving[1].due

    def new_epoch(self) -> None:
        """Declare that the next sample does not follow from the last: a new origin, or a state that was set by hand.

        The next sample then reports its past input as unknown, so that nothing is learned from it. Commands that answer
        older samples are refused, and the plan and the backup policy are dropped. Call this in `read`, before it
        returns the first new state. Another thread may call it too, but an old sample may then follow the call.
        """
        if self._serving is not None:
            self._serving[0].jump()

    def serve(self, read: Read, write: Write, stop: threading.Event | None = None) -> None:
        """Serve as the plant until `stop` is set or a signal ends the process. Waits for the router first.

        Both functions are called from this thread, one at a time. Their exceptions are counted, logged and reported in
        health, and the loop continues: a state that could not be measured is not published, and an input that could not
        be written counts as unknown. `read` is also called between samples if the backup policy or the safe input
        depends on the state.

        Args:
            read: returns the present state, (d,), in plant units. With an estimator, NaN is allowed for states whose
                sensor gives no number.
            write: applies an input, (m,), from now on; it is always within the bounds. It is called for every command,
                even if the input is the same, and at least every two periods, so that it can serve a watchdog.
            stop: the only way to end the loop outside the main thread, where signals do not arrive.

        Raises:
            ConfigError: this process may not use the configured core, or its certificate is not valid.
            PlantError: raised by one of the functions if the machine cannot continue.
        """
        config, run_id = self.config, new_run_id("plant")
        place = core_for(config, "plant", os.sched_getaffinity(0))
        patience = config.plant.plan_patience
        shield = Shield(self.known, config.period, patience, run_id, self._simulated, self._way_back)
        gaps = config.estimator.kind != "none"
        machine = Guarded(read, write, self.known.d, config.period, self._simulated, gaps)
        self._serving = shield, machine
        # Write the safe input also while there is no router.
        _leave_safe(shield, machine)
        with (
            stopped_by_signals(stop) as stopping,
            punctual(config.realtime.priority, keep_awake=config.awake) as note,
            _interruptible(),
            Bus(config, "plant", run_id, stopping) as bus,
        ):
            loop = _Loop(shield, machine, bus, self._simulated)
            info = run_info(config, "plant", run_id, self.known.units)
            standing = "; ".join(filter(None, (note, core_note(place))))
            with HealthPublisher(bus, info, loop.figures, standing) as health, on_core(place):
                try:
                    loop.run(health, stopping)
                finally:
                    _leave_safe(shield, machine)


def _leave_safe(shield: Shield, machine: Guarded) -> None:
    # The input does not matter if the machine is lost.
    with suppress(PlantError):
        if (u := shield.rest()) is not None:
            machine.write(u, clock.now())


@contextmanager
def _interruptible() -> Iterator[None]:
    """Accept a request to stop before there was a router."""
    try:
        yield
    except OpenInterrupted as interrupted:
        log.info("%s", interrupted)


class _Loop:
    """Takes samples on an absolute grid; between them, applies commands as they arrive and inputs as they are due."""

    def __init__(self, shield: Shield, machine: Guarded, bus: Bus, simulated: bool):
        self._shield, self._machine, self._bus, self._simulated = shield, machine, bus, simulated
        self._period = bus.config.period
        self._arrived = threading.Condition(threading.Lock())
        d, m = shield.plant.d, shield.plant.m
        self._commands: Inbox[Command] = Inbox(bus, topics.COMMAND, states=d, inputs=m, arrived=self._arrived)
        self._backups: Inbox[Backup] = Inbox(bus, topics.BACKUP, states=d, inputs=m, arrived=self._arrived)
        self._overrides: Inbox[Override] = Inbox(bus, topics.OVERRIDE, states=d, inputs=m)
        names = ("samples", "samples_skipped", "samples_late", *(f"driven_by_{source}" for source in NOTES))
        self._counts = dict.fromkeys(names, 0)
        self._source: InputSource = "hold"
        self._health: HealthPublisher | None = None

    def run(self, health: HealthPublisher, stop: threading.Event) -> None:
        """Run until `stop` is set. Raises `PlantError`."""
        self._health = health
        garbage = GarbageCollection.at(self._period)
        garbage.begin()
        pacer = Pacer(Grid(self._period, clock.now() + self._period), stop, partial(self._act_until, stop))
        while (turn := pacer.next()) is not None:
            self._sample(*turn)
            self._report()
            garbage.idle()

    def figures(self) -> dict[str, int]:
        """Return the counters for health, whose thread also runs while the loop waits for a call that hangs."""
        if self._machine.hangs:
            self._report()
        return self._counts | self._machine.counts

    def _report(self) -> None:
        if self._health is None:
            return
        moving, trouble = self._shield.moving, self._machine.trouble()
        note = BEFORE_COMMANDS if self._source == "safe" and not moving else NOTES[self._source]
        hand = self._shield.hand
        if self._source == "manual":
            note += f" ({hand.run_id})"
        elif hand.ended:
            note = "; ".join(filter(None, (note, f"{NO_LONGER}{hand.ended}")))
        status: ProcessStatus = "failed" if trouble else "running" if moving else "ready"
        self._health.set(status, "; ".join(filter(None, (trouble, note))))

    def _act_until(self, stop: threading.Event, time: float) -> bool:
        """Apply messages and due inputs until `time`; return False if told to stop."""
        # The loop sleeps before the sample, which is more punctual. Messages of that time act right after the sample.
        rest = time - STRETCH * self._period
        while not stop.is_set():
            self._take_orders()
            now = clock.now()
            self._act(min(now, time))
            if now >= rest:
                clock.sleep_until(time)
                self._act(time)
                return True
            wait = min(rest - now, max(0.0, self._shield.due - now), LONGEST_WAIT_S)
            with self._arrived:
                # Read policies now too. Reading them at the slot would delay its sample.
                self._arrived.wait_for(lambda: self._commands or self._backups, wait)
        return False

    def _act(self, t: float) -> None:
        if self._simulated:
            self._shield.advance(t, self._machine)
        elif self._shield.due <= t:
            # After a delay apply only the present input. A real machine must not get a burst of past inputs.
            self._shield.act(t, self._machine)

    def _sample(self, slot: Slot, lateness: float) -> None:
        counts = self._counts
        x = self._machine.read(slot.time)
        if x is not None:
            state = self._shield.sample(slot.time, x, self._machine.measured)
            self._bus.publish(topics.PLANT_STATE, state)
            counts["samples"] += 1
            counts[f"driven_by_{state.source}"] += 1
            self._source = state.source
        counts["samples_skipped"] += slot.skipped
        counts["samples_late"] += lateness > LATE * self._period
        self._shield.renew(slot.time, x, self._machine)

    def _take_orders(self) -> None:
        for received in self._commands.take_all():
            command = received.message
            verdict = self._shield.command(command, received.arrived)
            if verdict != "ok":
                detail = (
                    f"command {command.seq} of {command.run_id} for {command.state_seq}, {command.period} s"
                )
                self._bus.bad.count(topics.COMMAND.name, verdict, detail)
        for ready in self._backups.take_all():
            backup = ready.message
            verdict = self._shield.backup(backup)
            if verdict != "ok":
                self._bus.bad.count(
                    topics.BACKUP.name, verdict, f"for command {backup.seq} of {backup.run_id}"
                )
        for said in self._overrides.take_all():
            override = said.message
            outcome = self._shield.override(override, said.arrived)
            if outcome != "ok":
                detail = f"{override.mode}, {override.seq} of {override.run_id}"
                self._bus.bad.count(topics.OVERRIDE.name, outcome, detail)
