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
from node_runtime.health import HealthPublisher, HealthThread, run_info
from node_runtime.lifecycle import new_run_id
from node_runtime.realtime import clock
from trainer_node.fleet.discovery import SILENT, Finder
from trainer_node.node import NAMES, POLL, SHARE, TrainerNode, train_round

log = logging.getLogger(__name__)

ASKERS = 16
"""Plants that may be asked at once; one that does not answer keeps its place for two seconds."""
FLEET_SHARE = 0.9
"""Of the time, at most, is spent training many plants: a trainer of a fleet has a machine to itself."""
AT_ONCE = 16
"""Plants taken in between two looks at what has arrived."""
SAY_EVERY = 30.0
SHUNNED_S = 10.0


def seed_of(seed: int, plant: str) -> int:
    """A plant's own seed, from its name: neither the order of arrival nor the company changes it."""
    digest = hashlib.sha256(f"{seed}/{plant}".encode()).digest()
    return int.from_bytes(digest[:8], "big") >> 1


class _Followed(NamedTuple):
    node: TrainerNode
    lanes: Lanes
    end: ExitStack


class Fleet:
    """The plants that are there now. Everything happens in the thread that calls `run`."""

    def __init__(self, finder: Finder):
        self._finder = finder
        self._nodes: dict[str, _Followed] = {}
        self._shunned: dict[str, float] = {}
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
        self._gather(now)
        self._each(lambda node: node.listen(now), now)
        if now >= self._train_at:
            nodes = [followed.node for followed in self._nodes.values()]
            self._train_at = now + train_round(nodes, now) / self._share
        self._each(TrainerNode.tell, now)

    def _each(self, do: Callable[[TrainerNode], None], now: float) -> None:
        """For every plant; one with which it ends in an error that nobody foresaw must not end the others."""
        for name in self.plants:
            try:
                do(self._nodes[name].node)
            except Exception:
                log.exception("%s is left alone for %g s", name, SHUNNED_S)
                self._shunned[name] = now + SHUNNED_S
                self._drop(name)

    def _gather(self, now: float) -> None:
        self._shunned = {name: until for name, until in self._shunned.items() if now < until}
        present = [name for name in self._finder.present(now) if name not in self._shunned]
        for name in set(self._nodes) - set(present):
            log.info("%s: no link, or not a word for %.0f s; dropped until it comes back", name, SILENT)
            self._drop(name)
        for name in self.plants:
            # It may have been away and back between two looks: after a long round, with a new certificate.
            if self._finder.lanes(name) is not self._nodes[name].lanes:
                self._drop(name)
        # A few at a time: those that are here must not wait for all that come.
        for name in [name for name in present if name not in self._nodes][:AT_ONCE]:
            try:
                self._take_in(name)
            except zenoh.ZError as error:
                log.warning("%s could not be taken in: %s", name, error)
        if not present and now >= self._say_at:
            self._say_at = now + SAY_EVERY
            log.info("waiting for %s", self._finder.looks_for)

    def _take_in(self, name: str) -> None:
        said = self._finder.config(name)
        config = msgspec.structs.replace(said, seed=seed_of(said.seed, name))
        run_id, counts = new_run_id("trainer"), dict.fromkeys(NAMES, 0)
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
