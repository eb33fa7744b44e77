"""`tandem trainer --plants 'jet*'`: one trainer for all plants whose names match.

Plants are found by what their controllers publish. Each has a `TrainerNode` of its own, with its own samples, hidden
layers, counters and keys. What they share is the training: a round takes the plants that have waited longest, stacks
their networks, and trains all in one descent. The plant named in the configuration is a fleet of one.
"""

from __future__ import annotations

import fnmatch
import hashlib
import logging
import re
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack

import msgspec
import zenoh

from node_runtime import clock
from node_runtime.config import Config
from node_runtime.health import HealthPublisher, Heart, run_info
from node_runtime.lifecycle import new_run_id
from protocol import topics
from trainer_node.node import NAMES, POLL, SHARE, TrainerNode, train_round
from trainer_node.plant_bus import PlantBus, Sessions

log = logging.getLogger(__name__)

SILENT = 10.0
"""Seconds without a word of its controller after which a plant is dropped; it may come back at any time."""
MOST = 1024
"""Plants followed at once: a stranger who invents names must not fill the memory."""
ASKERS = 16
"""Plants that may be asked at once; one that does not answer keeps its place for two seconds."""
FLEET_SHARE = 0.9
"""Of the time, at most, is spent training many plants: a trainer of a fleet has a machine to itself."""
AT_ONCE = 16
"""Plants taken in between two looks at what has arrived."""
SAY_EVERY = 30.0
FOUND_BY = (topics.SAMPLES, topics.OUTPUT_WEIGHTS, topics.RUN_INFO["controller"], topics.HEALTH["controller"])
NAME = re.compile(r"[A-Za-z0-9_-]{1,40}")


class Heard:
    """Which plants were heard of last when; any thread may write."""

    def __init__(self, plants: str):
        self._plants = plants
        self._at: dict[str, float] = {}
        self._lock = threading.Lock()

    def note(self, key: str, now: float) -> None:
        """A message arrived at this key. Names that do not match, and those beyond `MOST`, are ignored."""
        name = key.split("/", 2)[1]
        with self._lock:
            if name in self._at or (
                len(self._at) < MOST and NAME.fullmatch(name) and fnmatch.fnmatchcase(name, self._plants)
            ):
                self._at[name] = now

    def present(self, now: float) -> list[str]:
        """Names heard of within `SILENT`, sorted; the others are forgotten."""
        with self._lock:
            self._at = {name: at for name, at in self._at.items() if now - at <= SILENT}
            return sorted(self._at)


def seed_of(seed: int, plant: str) -> int:
    """A plant's own seed, from its name: neither the order of arrival nor the company changes it."""
    digest = hashlib.sha256(f"{seed}/{plant}".encode()).digest()
    return int.from_bytes(digest[:8], "big") >> 1


class Fleet:
    """The plants that are there now. Everything happens in the thread that calls `run`."""

    def __init__(self, config: Config, plants: str, sessions: Sessions):
        """`plants`: a pattern as of fnmatch, or one name, which is followed from the start and kept."""
        self._config, self._plants, self._sessions = config, plants, sessions
        self._named = [plants] if NAME.fullmatch(plants) else []
        self._heard = Heard(plants)
        self._nodes: dict[str, tuple[TrainerNode, ExitStack]] = {}
        self._pool = ThreadPoolExecutor(ASKERS, "ask")
        self._heart = Heart()
        self._share = SHARE if self._named else FLEET_SHARE
        self._train_at = 0.0
        self._say_at = 0.0

    @property
    def plants(self) -> list[str]:
        """Names of the plants followed now."""
        return sorted(self._nodes)

    def run(self, stop: threading.Event) -> None:
        """Until `stop` is set."""
        subscribers = [] if self._named else [self._listen(topic.key("*")) for topic in FOUND_BY]
        with self._heart:
            try:
                while not stop.wait(POLL):
                    self.turn(clock.now())
            finally:
                for subscriber in subscribers:
                    subscriber.undeclare()
                for name in self.plants:
                    self._drop(name)
                self._pool.shutdown(cancel_futures=True)

    def turn(self, now: float) -> None:
        """Who is there, what has arrived for each, and a round of training when it is time."""
        self._gather(now)
        nodes = [node for node, _ in self._nodes.values()]
        for node in nodes:
            node.listen(now)
        if now >= self._train_at:
            self._train_at = now + train_round(nodes, now) / self._share
        for node in nodes:
            node.tell()

    def _gather(self, now: float) -> None:
        present = self._named or self._heard.present(now)
        for name in set(self._nodes) - set(present):
            log.info("%s has been silent for %.0f s; dropped until it comes back", name, SILENT)
            self._drop(name)
        # A few at a time: those that are here must not wait for all that come.
        for name in [name for name in present if name not in self._nodes][:AT_ONCE]:
            self._take_in(name)
        if not present and now >= self._say_at:
            self._say_at = now + SAY_EVERY
            log.info("no plant matches %r yet; waiting for one", self._plants)

    def _take_in(self, name: str) -> None:
        config = msgspec.structs.replace(self._config, name=name, seed=seed_of(self._config.seed, name))
        run_id, counts = new_run_id("trainer"), dict.fromkeys(NAMES, 0)
        with ExitStack() as stack:
            bus = stack.enter_context(PlantBus(config, "trainer", run_id, self._sessions))
            info = run_info(msgspec.structs.replace(config, seed=self._config.seed), "trainer", run_id)
            health = stack.enter_context(HealthPublisher(bus, info, counts.copy, heart=self._heart))
            node = TrainerNode(config, bus, health, counts, self._pool)
            node.start()
            self._nodes[name] = node, stack.pop_all()
        if not self._named:
            log.info("%s has come; %d plants", name, len(self._nodes))

    def _drop(self, name: str) -> None:
        _, stack = self._nodes.pop(name)
        stack.close()

    def _listen(self, key: str) -> zenoh.Subscriber[None]:
        def arrived(sample: zenoh.Sample) -> None:
            self._heard.note(str(sample.key_expr), time.monotonic())

        return self._sessions.bulk.declare_subscriber(key, zenoh.handlers.Callback(arrived, indirect=False))
