"""How the plants of a fleet are found: by name or by a pattern behind one router, or each behind its own."""

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
"""Seconds without a word of its controller after which a plant is dropped; it may come back at any time."""
MOST_PLANTS = 1024
"""Plants followed at once: a stranger who invents names must not fill the memory."""
TRY_AGAIN_S = 10.0
"""Seconds after which a router that refused us is tried again: a certificate may have been renewed."""
LET_GO_S = 1.0
"""Seconds from the end of a certificate until its lanes are closed."""
NAME = re.compile(PLANT_NAME)
FOUND_BY = (topics.SAMPLES, topics.OUTPUT_WEIGHTS, topics.RUN_INFO["controller"], topics.HEALTH["controller"])
READABLE = (topics.SAMPLES, topics.OUTPUT_WEIGHTS)
"""Of these, what a trainer's certificate may read."""


class PlantFinder(Protocol):
    """Which plants are there, and how they are reached. Entered before it is asked."""

    many: bool
    """The trainer is that of a fleet, and not of one plant whose controller may share its machine."""
    looks_for: str
    """In words, for the log."""

    def __enter__(self) -> object: ...

    def __exit__(self, *_: object) -> None: ...

    def present(self, now: float) -> Sequence[str]:
        """Names of the plants that are there, sorted; `now` on the monotonic clock."""
        ...

    def config(self, plant: str) -> Config:
        """With the plant's name, and the address under which it is reached."""
        ...

    def lanes(self, plant: str) -> Lanes:
        """Where it is reached."""
        ...


class LastHeard:
    """Which plants were heard of last when; any thread may write."""

    def __init__(self, plants: str):
        self._plants = plants
        self._at: dict[str, float] = {}
        self._lock = threading.Lock()

    def note(self, key: str, now: float) -> None:
        """A message arrived at this key. Names that do not match, and those beyond `MOST_PLANTS`, are ignored."""
        name = key.split("/", 2)[1]
        with self._lock:
            if name in self._at or (
                len(self._at) < MOST_PLANTS
                and NAME.fullmatch(name)
                and fnmatch.fnmatchcase(name, self._plants)
            ):
                self._at[name] = now

    def present(self, now: float) -> list[str]:
        """Names heard of within `SILENT_S`, sorted; the others are forgotten."""
        with self._lock:
            self._at = {name: at for name, at in self._at.items() if now - at <= SILENT_S}
            return sorted(self._at)

    def listen(self, session: zenoh.Session, plant: str, to: Iterable[Topic]) -> list[zenoh.Subscriber[None]]:
        """Note what arrives for this plant, `*` for any."""

        def arrived(sample: zenoh.Sample) -> None:
            self.note(str(sample.key_expr), clock.now())

        callback = zenoh.handlers.Callback(arrived, indirect=False)
        return [session.declare_subscriber(topic.key(plant), callback) for topic in to]


class SharedRouter:
    """Plants behind the router of the configuration: one, followed from the start, or all that match a pattern."""

    def __init__(self, config: Config, plants: str, lanes: Lanes):
        """`plants`: a pattern as of fnmatch, or one name."""
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
    """Plants with a router each, by the list `trainer.fleet`; one that cannot be reached holds up no other.

    Each link has its plant's own certificate, so who takes one of them has one plant's trainer and nothing else.
    """

    many = True

    def __init__(self, config: Config, places: Sequence[PlantPlace], stop: threading.Event):
        self._config, self._stop = config, stop
        self._places = {place.name: place for place in places}
        self.looks_for = f"the controller of {', '.join(self._places)}"
        self._heard = LastHeard("*")
        self._lock = threading.Lock()
        self._reached: dict[str, Lanes] = {}
        """The latest of each plant, whether they are open still or not."""
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
        # The other plants are none of its business.
        trainer = msgspec.structs.replace(self._config.trainer, fleet=[])
        return msgspec.structs.replace(self._config, name=plant, bus=bus, trainer=trainer)

    def lanes(self, plant: str) -> Lanes:
        return self._reached[plant]

    def _reach(self, name: str) -> None:
        """In a thread of its own: keep the plant's lanes open, anew with a new certificate when one is over."""
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
                    # The fleet lets go of the plant first, and says a last word for it.
                    self._leaving.wait(LET_GO_S)
            except OpenInterrupted:
                return
            except (ConfigError, zenoh.ZError) as error:
                log.error("%s: %s; trying again every %g s", name, error, TRY_AGAIN_S)
                self._leaving.wait(TRY_AGAIN_S)
            except Exception:
                log.exception("%s: trying again every %g s", name, TRY_AGAIN_S)
                self._leaving.wait(TRY_AGAIN_S)


def _valid_s(config: Config) -> float | None:
    """For how many seconds the certificate for this address is valid, and a moment more; None: it needs none."""
    if not secure(config.bus.endpoint):
        return None
    # Only here, for a machine that needs no certificates loads nothing for them.
    from node_runtime.tls import credentials

    own = credentials.of_process(config.bus.tls.keys, "trainer", config.name)
    return min(own.days_left() * 86400.0 + 1.0, threading.TIMEOUT_MAX)


def _undeclare(subscribers: Iterable[zenoh.Subscriber[None]]) -> None:
    for subscriber in subscribers:
        # The session may be gone already.
        with contextlib.suppress(zenoh.ZError):
            subscriber.undeclare()
