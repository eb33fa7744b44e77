"""One trainer for several plants, for `tandem trainer --plants 'jet*'` or the list `trainer.fleet`.

`fleet.discovery` finds the present plants. Each has a `TrainerNode` of its own with its own samples, hidden layers,
counters and keys. They share the training: a round takes the plants that have waited longest, stacks their networks,
and trains all of them in one descent. The configured plant alone is a fleet of one.
"""

from __future__ import annotations

import hashlib
import logging
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from typing import NamedTuple

import msgspec
import zenoh

from node_runtime.bus.lanes import Lanes
from node_runtime.bus.zenoh_bus import Bus
from node_runtime.health import HealthPublisher, HealthThread
from node_runtime.lifecycle import new_run_id
from node_runtime.provenance import run_info
from node_runtime.realtime import clock
from trainer_node.fleet.discovery import SILENT_S, PlantFinder
from trainer_node.node import COUNTERS, POLL, SHARE, TrainerNode
from trainer_node.training_round import train_round

log = logging.getLogger(__name__)

ASKERS = 16
"""Number of plants that can be queried at once. A plant without an answer occupies its place for two seconds."""
FLEET_SHARE = 0.9
"""Largest share of the time spent on training several plants, because a fleet's trainer has a machine of its own."""
ADDED_AT_ONCE = 16
"""Number of plants added between two checks for messages."""
LOG_EVERY_S = 30.0
"""Seconds between two log lines while there is no plant."""
PAUSE_S = 10.0
"""Seconds for which a plant is not added again after an unexpected error."""


def seed_of(seed: int, plant: str) -> int:
    """Return a plant's own seed from its name, so that it does not depend on other plants or on their order."""
    digest = hashlib.sha256(f"{seed}/{plant}".encode()).digest()
    return int.from_bytes(digest[:8], "big") >> 1


class _Followed(NamedTuple):
    """A plant: its trainer, its lanes, and the exit of its context managers."""

    node: TrainerNode
    lanes: Lanes
    end: ExitStack


class Fleet:
    """The present plants. Everything happens in the thread that calls `run`."""

    def __init__(self, finder: PlantFinder):
        self._finder = finder
        self._nodes: dict[str, _Followed] = {}
        self._paused: dict[str, float] = {}
        self._pool = ThreadPoolExecutor(ASKERS, "ask")
        self._health_thread = HealthThread()
        self._share = FLEET_SHARE if finder.many else SHARE
        self._train_at = 0.0
        self._log_at = 0.0

    @property
    def plants(self) -> list[str]:
        """Names of the plants that are followed now."""
        return sorted(self._nodes)

    def run(self, stop: threading.Event) -> None:
        """Run until `stop` is set."""
        with self._finder, self._health_thread:
            try:
                while not stop.wait(POLL):
                    self.turn(clock.now())
            finally:
                for name in self.plants:
                    self._drop(name)
                self._pool.shutdown(cancel_futures=True)

    def turn(self, now: float) -> None:
        """Update the plants, handle their messages, and train a round if it is due."""
        self._update_plants(now)
        self._each(lambda node: node.listen(now), now)
        if now >= self._train_at:
            nodes = [followed.node for followed in self._nodes.values()]
            self._train_at = now + train_round(nodes, now) / self._share
        self._each(TrainerNode.update_counters, now)

    def _each(self, do: Callable[[TrainerNode], None], now: float) -> None:
        """Call a function for every plant. An unexpected error drops that plant and does not affect the others."""
        for name in self.plants:
            try:
                do(self._nodes[name].node)
            except Exception:
                log.exception("%s: dropped for %g s after an unexpected error", name, PAUSE_S)
                self._paused[name] = now + PAUSE_S
                self._drop(name)

    def _update_plants(self, now: float) -> None:
        self._paused = {name: until for name, until in self._paused.items() if now < until}
        present = [name for name in self._finder.present(now) if name not in self._paused]
        for name in set(self._nodes) - set(present):
            log.info("%s: no link, or no message for %.0f s; dropped until it returns", name, SILENT_S)
            self._drop(name)
        for name in self.plants:
            # It may have gone and returned between two checks: during a long round, or with a new certificate.
            if self._finder.lanes(name) is not self._nodes[name].lanes:
                self._drop(name)
        # Add a few at a time, so that the present plants do not wait for all new ones.
        for name in [name for name in present if name not in self._nodes][:ADDED_AT_ONCE]:
            try:
                self._add_plant(name)
            except zenoh.ZError as error:
                log.warning("%s could not be added: %s", name, error)
        if not present and now >= self._log_at:
            self._log_at = now + LOG_EVERY_S
            log.info("waiting for %s", self._finder.looks_for)

    def _add_plant(self, name: str) -> None:
        said = self._finder.config(name)
        config = msgspec.structs.replace(said, seed=seed_of(said.seed, name))
        run_id, counts = new_run_id("trainer"), dict.fromkeys(COUNTERS, 0)
        with ExitStack() as stack:
            lanes = self._finder.lanes(name)
            bus = stack.enter_context(Bus(config, "trainer", run_id, lanes=lanes))
            info = run_info(said, "trainer", run_id)
            health = stack.enter_context(HealthPublisher(bus, info, counts.copy, thread=self._health_thread))
            node = TrainerNode(config, bus, health, counts, self._pool)
            node.start()
            self._nodes[name] = _Followed(node, lanes, stack.pop_all())
        if self._finder.many:
            log.info("%s added; %d plants", name, len(self._nodes))

    def _drop(self, name: str) -> None:
        self._nodes.pop(name).end.close()
