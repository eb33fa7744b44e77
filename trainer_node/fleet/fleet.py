"""One trainer for many plants, `tandem trainer --plants 'jet*'` or the list `trainer.fleet`.

`fleet.discovery` says which plants are there. Each has a `TrainerNode` of its own, with its own samples, hidden
layers, counters and keys. What they share is the training: a round takes the plants that have waited longest, stacks
their networks, and trains all in one descent. The plant named in the configuration is a fleet of one.
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
"""Plants that may be asked at once; one that does not answer keeps its place for two seconds."""
FLEET_SHARE = 0.9
"""Of the time, at most, is spent training many plants: a trainer of a fleet has a machine to itself."""
TAKEN_IN_AT_ONCE = 16
"""Plants taken in between two looks at what has arrived."""
SAY_EVERY_S = 30.0
"""Between two words that no plant is there."""
LEFT_ALONE_S = 10.0
"""For how long a plant is not taken in again after an error that nobody foresaw."""


def seed_of(seed: int, plant: str) -> int:
    """A plant's own seed, from its name: neither the order of arrival nor the company changes it."""
    digest = hashlib.sha256(f"{seed}/{plant}".encode()).digest()
    return int.from_bytes(digest[:8], "big") >> 1


class _Followed(NamedTuple):
    """A plant: its trainer, where it is reached, and how to let go of it."""

    node: TrainerNode
    lanes: Lanes
    end: ExitStack


class Fleet:
    """The plants that are there now. Everything happens in the thread that calls `run`."""

    def __init__(self, finder: PlantFinder):
        self._finder = finder
        self._nodes: dict[str, _Followed] = {}
        self._left_alone: dict[str, float] = {}
        self._pool = ThreadPoolExecutor(ASKERS, "ask")
        self._health_thread = HealthThread()
        self._share = FLEET_SHARE if finder.many else SHARE
        self._train_at = 0.0
        self._say_at = 0.0

    @property
    def plants(self) -> list[str]:
        """Names of the plants followed now."""
        return sorted(self._nodes)

    def run(self, stop: threading.Event) -> None:
        """Until `stop` is set."""
        with self._finder, self._health_thread:
            try:
                while not stop.wait(POLL):
                    self.turn(clock.now())
            finally:
                for name in self.plants:
                    self._drop(name)
                self._pool.shutdown(cancel_futures=True)

    def turn(self, now: float) -> None:
        """Who is there, what has arrived for each, and a round of training when it is time."""
        self._update_plants(now)
        self._each(lambda node: node.listen(now), now)
        if now >= self._train_at:
            nodes = [followed.node for followed in self._nodes.values()]
            self._train_at = now + train_round(nodes, now) / self._share
        self._each(TrainerNode.update_counters, now)

    def _each(self, do: Callable[[TrainerNode], None], now: float) -> None:
        """For every plant; one with which it ends in an error that nobody foresaw must not end the others."""
        for name in self.plants:
            try:
                do(self._nodes[name].node)
            except Exception:
                log.exception("%s is left alone for %g s", name, LEFT_ALONE_S)
                self._left_alone[name] = now + LEFT_ALONE_S
                self._drop(name)

    def _update_plants(self, now: float) -> None:
        self._left_alone = {name: until for name, until in self._left_alone.items() if now < until}
        present = [name for name in self._finder.present(now) if name not in self._left_alone]
        for name in set(self._nodes) - set(present):
            log.info("%s: no link, or not a word for %.0f s; dropped until it comes back", name, SILENT_S)
            self._drop(name)
        for name in self.plants:
            # It may have been away and back between two looks: after a long round, with a new certificate.
            if self._finder.lanes(name) is not self._nodes[name].lanes:
                self._drop(name)
        # A few at a time: those that are here must not wait for all that come.
        for name in [name for name in present if name not in self._nodes][:TAKEN_IN_AT_ONCE]:
            try:
                self._take_in(name)
            except zenoh.ZError as error:
                log.warning("%s could not be taken in: %s", name, error)
        if not present and now >= self._say_at:
            self._say_at = now + SAY_EVERY_S
            log.info("waiting for %s", self._finder.looks_for)

    def _take_in(self, name: str) -> None:
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
            log.info("%s has come; %d plants", name, len(self._nodes))

    def _drop(self, name: str) -> None:
        self._nodes.pop(name).end.close()
