"""`tandem plant`: the simulated plant in real time, on the bus."""

from __future__ import annotations

import logging
import os
import threading

from lbmpc.plants import PlantError, get_plant, true_motion
from node_runtime.bus.inbox import Inbox
from node_runtime.bus.zenoh_bus import Bus
from node_runtime.config.plant import initial_state, plant_of, true_plant_of
from node_runtime.config.sections import Config
from node_runtime.health import HealthPublisher
from node_runtime.lifecycle import new_run_id, run_process
from node_runtime.provenance import run_info
from node_runtime.realtime import clock
from node_runtime.realtime.pacer import Grid, Pacer
from node_runtime.realtime.scheduling import GarbageCollection, core_for, core_note, on_core, punctual
from plant_sim.simulator import PlantSim
from protocol import topics
from protocol.messages import Backup, Command, InputSource

log = logging.getLogger(__name__)

IN_ADVANCE_FROM = 0.005
"""Seconds. A shorter period is integrated in one step, which takes less time than to wake up for it."""
NOTES: dict[InputSource, str] = {
    "hold": "held at x0 until the first command",
    "command": "",
    "plan": "no fresh command: following the backup policy, or the last plan",
    "safe": "no fresh command and nothing left to follow: safe input",
}


def build(config: Config, run_id: str) -> PlantSim:
    """The plant that the configuration names, as it really moves. Raises `ConfigError`."""
    plant, truth = plant_of(config, get_plant), true_plant_of(config, get_plant)
    x0 = initial_state(config, plant)
    return PlantSim(plant, true_motion(truth), config.period, x0, config.plant.plan_patience, run_id)


class PlantNode:
    """Samples on an absolute grid, applies commands at the times they arrived."""

    def __init__(self, sim: PlantSim, bus: Bus, health: HealthPublisher, counts: dict[str, int]):
        """`counts`: this node's own figures, kept up to date here."""
        self._sim = sim
        self._bus = bus
        self._health = health
        self._counts = counts
        self._commands: Inbox[Command] = Inbox(bus, topics.COMMAND, states=sim.plant.d, inputs=sim.plant.m)
        self._backups: Inbox[Backup] = Inbox(bus, topics.BACKUP, states=sim.plant.d, inputs=sim.plant.m)

    def run(self, stop: threading.Event) -> None:
        """Until `stop` is set. Raises `PlantError`."""
        garbage = GarbageCollection.at(self._sim.period)
        garbage.begin()
        pacer = Pacer(Grid(self._sim.period, clock.now() + self._sim.period), stop)
        while (turn := pacer.next()) is not None:
            slot, lateness = turn
            self._take_commands()
            state = self._sim.sample(slot.time)
            self._bus.publish(topics.PLANT_STATE, state)
            self._counts["samples"] += 1
            self._counts["samples skipped"] += slot.skipped
            self._counts["samples late"] += lateness > 0.2 * self._sim.period
            self._counts[f"driven by {state.source}"] += 1
            self._health.set("running" if self._sim.moving else "ready", NOTES[state.source])
            garbage.idle()
            if self._sim.period < IN_ADVANCE_FROM:
                continue
            # This period's command is normally here by now: work out the next sample in advance.
            if not pacer.sleep_until(slot.time + 0.5 * self._sim.period):
                return
            self._take_commands()
            self._sim.prepare(slot.time + self._sim.period)

    def _take_commands(self) -> None:
        for received in self._commands.take_all():
            verdict = self._sim.command(received.message, received.arrived)
            if verdict != "ok":
                command = received.message
                detail = (
                    f"command {command.seq} of {command.run_id} for {command.state_seq}, {command.period} s"
                )
                self._bus.bad.count(topics.COMMAND.name, verdict, detail)
        for ready in self._backups.take_all():
            verdict = self._sim.backup(ready.message)
            if verdict != "ok":
                backup = ready.message
                self._bus.bad.count(
                    topics.BACKUP.name, verdict, f"for command {backup.seq} of {backup.run_id}"
                )


def main(config: Config, stop: threading.Event | None = None) -> int:
    """`tandem plant`. 0 when told to stop, 2 for a wrong configuration, 3 when the plant's motion ended."""
    return run_process(lambda stopping: _live(config, stopping), stop)


def _live(config: Config, stopping: threading.Event) -> int:
    run_id = new_run_id("plant")
    sim = build(config, run_id)
    names = ("samples", "samples skipped", "samples late", *(f"driven by {source}" for source in NOTES))
    counts = dict.fromkeys(names, 0)
    place = core_for(config, "plant", os.sched_getaffinity(0))
    with punctual(config.realtime.priority, keep_awake=config.awake) as note:
        info = run_info(config, "plant", run_id, sim.plant.units)
        standing = "; ".join(filter(None, (note, core_note(place))))
        with (
            Bus(config, "plant", run_id, stopping) as bus,
            HealthPublisher(bus, info, lambda: counts, standing) as health,
        ):
            try:
                node = PlantNode(sim, bus, health, counts)
                with on_core(place):
                    node.run(stopping)
            except PlantError as error:
                log.error("%s", error)
                health.set("failed", str(error))
                return 3
    return 0
