"""A commander's place on the bus: it says something, says it again in time, and hears what becomes of it."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from node_runtime.bus.zenoh_bus import Bus, OpenInterrupted
from node_runtime.config.sections import Config
from node_runtime.lifecycle import new_run_id, stopped_by_signals
from node_runtime.realtime import clock
from protocol import codec, topics
from protocol.messages import Message, Override, Reference
from tandem.terminal import Refused

REACHED_S = 5.0
"""Seconds within which there must be a router."""
LEASE_S, LEASE_PERIODS, LONGEST_LEASE_S = 1.0, 3.0, 60.0
RENEWALS = 3
"""Of a lease: two may be lost."""
LAST_WORDS, LAST_WORDS_S = 3, 0.1
"""How often and how far apart what ends something is said: the control lane drops what finds no room."""

HEARD = (topics.PLANT_STATE, topics.OVERRIDE, topics.REFERENCE, topics.HEALTH["plant"])
SAID_AT = {Override: topics.OVERRIDE, Reference: topics.REFERENCE}


def lease_of(period: float) -> float:
    """Seconds for which a word counts in a loop of this period, in seconds."""
    return min(max(LEASE_S, LEASE_PERIODS * period), LONGEST_LEASE_S)


class Commander:
    """One intention of a person: all that it says has one run id, and numbers that count up."""

    def __init__(self, config: Config, bus: Bus, stopping: threading.Event):
        self.config, self.run_id, self.stopping = config, bus.run_id, stopping
        self._bus = bus
        self._mailbox = bus.everything()
        self._heard = {topic.key(config.name): topic for topic in HEARD}

    def say(self, message: Message) -> None:
        """Send one override or reference."""
        self._bus.publish(SAID_AT[type(message)], message)

    def say_last(self, message: Message) -> None:
        """Send what ends something: more than once, and until it has left."""
        for _ in range(LAST_WORDS):
            self.say(message)
            clock.sleep_until(clock.now() + LAST_WORDS_S)

    def hear(self, until: float) -> Iterator[Message]:
        """What others say, up to that time on the monotonic clock, or until it is to stop."""
        while not self.stopping.is_set():
            left = until - clock.now()
            delivery = self._mailbox.get(min(max(left, 0.0), 0.1))
            if delivery is None:
                if left <= 0.0:
                    return
                continue
            topic = self._heard.get(delivery.key)
            if topic is None:
                continue
            try:
                message = codec.decode(topic, delivery.payload)
            except codec.BadMessage:
                continue
            if message.run_id != self.run_id:
                yield message


@contextmanager
def commanding(config: Config) -> Iterator[Commander]:
    """On the bus, until the end of the block; Ctrl-C sets `stopping` meanwhile.

    Raises:
        ConfigError: no certificate that can be used.
        Refused: there is no router, or it lets nobody in.
    """
    with stopped_by_signals() as stopping:
        timer = threading.Timer(REACHED_S, stopping.set)
        timer.daemon = True
        timer.start()
        try:
            with Bus(config, topics.COMMANDER, new_run_id(topics.COMMANDER), stopping) as bus:
                timer.cancel()
                yield Commander(config, bus, stopping)
        except OpenInterrupted as interrupted:
            raise Refused(f"no router at {config.bus.endpoint} within {REACHED_S:g} s") from interrupted
        finally:
            timer.cancel()
