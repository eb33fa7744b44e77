"""Finds the plants of a fleet: by name or pattern behind one router, or each behind a router of its own."""

from __future__ import annotations

import contextlib
import fnmatch
import logging
import re
import threading
from collections.abc import Iterable, Sequence
from typing import Protocol

import msgspec
import zenoh

from node_runtime.bus.lanes import Lanes
from node_runtime.bus.session import OpenInterrupted, secure
from node_runtime.config.sections import PLANT_NAME, Config, PlantPlace
from node_runtime.config.strict import ConfigError
from node_runtime.realtime import clock
from protocol import topics
from protocol.topics import Topic

log = logging.getLogger(__name__)

SILENT_S = 10.0
"""Seconds without a message from its controller after which a plant is dropped; it may return at any time."""
MOST_PLANTS = 1024
"""Largest number of plants at once, because a foreign sender may invent names."""
TRY_AGAIN_S = 10.0
"""Seconds between attempts to reach a router that refused the trainer; its certificate may have been renewed."""
LET_GO_S = 1.0
"""Seconds from the end of a certificate until its lanes are closed."""
NAME = re.compile(PLANT_NAME)
FOUND_BY = (topics.SAMPLES, topics.OUTPUT_WEIGHTS, topics.RUN_INFO["controller"], topics.HEALTH["controller"])
READABLE = (topics.SAMPLES, topics.OUTPUT_WEIGHTS)
"""Topics among these that a trainer's certificate may read."""


class PlantFinder(Protocol):
    """Finds the present plants and their addresses. Enter it before use."""

    many: bool
    """True for the trainer of a fleet; False for that of one plant, whose controller may share the machine."""
    looks_for: str
    """Description of the plants, for the log."""

    def __enter__(self) -> object: ...

    def __exit__(self, *_: object) -> None: ...

    def present(self, now: float) -> Sequence[str]:
        """Return the names of the present plants, sorted; `now` on the monotonic clock."""
        ...

    def config(self, plant: str) -> Config:
        """Return the configuration with the plant's name and address."""
        ...

    def lanes(self, plant: str) -> Lanes:
        """Return the lanes to the plant's router."""
        ...


class LastHeard:
    """The time of the last message of each plant. Any thread may write."""

    def __init__(self, plants: str):
        self._plants = plants
        self._at: dict[str, float] = {}
        self._lock = threading.Lock()

    def note(self, key: str, now: float) -> None:
        """Record a message at this key. Names that do not match, and those beyond `MOST_PLANTS`, are ignored."""
        name = key.split("/", 2)[1]
        with self._lock:
            if name in self._at or (
                len(self._at) < MOST_PLANTS
                and NAME.fullmatch(name)
                and fnmatch.fnmatchcase(name, self._plants)
            ):
                self._at[name] = now

    def present(self, now: float) -> list[str]:
        """Return the names with messages within `SILENT_S`, sorted, and forget the others."""
        with self._lock:
            self._at = {name: at for name, at in self._at.items() if now - at <= SILENT_S}
            return sorted(self._at)

    def listen(self, session: zenoh.Session, plant: str, to: Iterable[Topic]) -> list[zenoh.Subscriber[None]]:
        """Subscribe to the messages of this plant, `*` for any plant."""

        def arrived(sample: zenoh.Sample) -> None:
            self.note(str(sample.key_expr), clock.now())

        callback = zenoh.handlers.Callback(arrived, indirect=False)
        return [session.declare_subscriber(topic.key(plant), callback) for topic in to]


class SharedRouter:
    """Plants behind the configured router: one, followed from the start, or all that match a pattern."""

    def __init__(self, config: Config, plants: str, lanes: Lanes):
        """`plants`: a pattern for fnmatch, or one name."""
        self._config, self._lanes = config, lanes
        self._named = [plants] if NAME.fullmatch(plants) else []
        self.many, self.looks_for = not self._named, f"a plant that matches {plants!r}"
        self._heard = LastHeard(plants)
        self._subscribers: list[zenoh.Subscriber[None]] = []

    def __enter__(self) -> SharedRouter:
        if not self._named:
            self._subscribers = self._heard.listen(self._lanes.session("bulk"), "*", FOUND_BY)
        return self

    def __exit__(self, *_: object) -> None:
        _undeclare(self._subscribers)

    def present(self, now: float) -> Sequence[str]:
        return self._named or self._heard.present(now)

    def config(self, plant: str) -> Config:
        return msgspec.structs.replace(self._config, name=plant)

    def lanes(self, plant: str) -> Lanes:
        return self._lanes


class RouterPerPlant:
    """Plants with a router each, from the list `trainer.fleet`. A router that cannot be reached delays no other.

    Each link uses its plant's own certificate, so a stolen certificate gives access to one plant's trainer only.
    """

    many = True

    def __init__(self, config: Config, places: Sequence[PlantPlace], stop: threading.Event):
        self._config, self._stop = config, stop
        self._places = {place.name: place for place in places}
        self.looks_for = f"the controller of {', '.join(self._places)}"
        self._heard = LastHeard("*")
        self._lock = threading.Lock()
        self._reached: dict[str, Lanes] = {}
        """The latest lanes of each plant, open or closed."""
        self._open: set[str] = set()
        self._leaving = threading.Event()
        self._threads = [
            threading.Thread(target=self._reach, args=(name,), name=f"reach {name}", daemon=True)
            for name in self._places
        ]

    def __enter__(self) -> RouterPerPlant:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._leaving.set()
        for thread in self._threads:
            thread.join(3.0)

    def present(self, now: float) -> Sequence[str]:
        with self._lock:
            return [name for name in self._heard.present(now) if name in self._open]

    def config(self, plant: str) -> Config:
        place, bus = self._places[plant], self._config.bus
        tls = msgspec.structs.replace(bus.tls, keys=place.keys or bus.tls.keys)
        bus = msgspec.structs.replace(bus, endpoint=place.endpoint, tls=tls)
        # The list of the other plants is removed, because it is not needed.
        trainer = msgspec.structs.replace(self._config.trainer, fleet=[])
        return msgspec.structs.replace(self._config, name=plant, bus=bus, trainer=trainer)

    def lanes(self, plant: str) -> Lanes:
        return self._reached[plant]

    def _reach(self, name: str) -> None:
        """Keep a plant's lanes open, in a thread of its own, and reopen them with a new certificate."""
        config = self.config(name)
        while not self._leaving.is_set():
            try:
                valid_s = _valid_s(config)
                with Lanes(config, "trainer", self._stop) as lanes:
                    subscribers = self._heard.listen(lanes.session("bulk"), name, READABLE)
                    with self._lock:
                        self._reached[name] = lanes
                        self._open.add(name)
                    log.info("%s: reached at %s", name, config.bus.endpoint)
                    self._leaving.wait(valid_s)
                    with self._lock:
                        self._open.discard(name)
                    _undeclare(subscribers)
                    # The fleet drops the plant first and publishes its last health.
                    self._leaving.wait(LET_GO_S)
            except OpenInterrupted:
                return
            except (ConfigError, zenoh.ZError) as error:
                log.error("%s: %s; retrying every %g s", name, error, TRY_AGAIN_S)
                self._leaving.wait(TRY_AGAIN_S)
            except Exception:
                log.exception("%s: retrying every %g s", name, TRY_AGAIN_S)
                self._leaving.wait(TRY_AGAIN_S)


def _valid_s(config: Config) -> float | None:
    """Return the seconds for which the certificate is valid, plus a moment; None if the address needs none."""
    if not secure(config.bus.endpoint):
        return None
    # Imported here, so that a machine without certificates imports nothing for them.
    from node_runtime.tls import credentials

    own = credentials.of_process(config.bus.tls.keys, "trainer", config.name)
    return min(own.days_left() * 86400.0 + 1.0, threading.TIMEOUT_MAX)


def _undeclare(subscribers: Iterable[zenoh.Subscriber[None]]) -> None:
    for subscriber in subscribers:
        # The session may be closed already.
        with contextlib.suppress(zenoh.ZError):
            subscriber.undeclare()
