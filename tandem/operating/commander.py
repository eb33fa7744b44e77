"""A client on the bus in the role `commander`: it gives set-points or drives the plant manually.

With certificates it needs the commander's own. Its messages travel on the control lane, where a message may be lost.
It therefore repeats a message until an answer shows that it was accepted, and while it must hold.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import msgspec

from node_runtime.bus.zenoh_bus import Bus, OpenInterrupted
from node_runtime.config.sections import Config
from node_runtime.lifecycle import new_run_id
from node_runtime.realtime import clock
from protocol import codec, topics
from protocol import messages as m
from protocol.topics import Topic
from tandem.terminal import Refused

Word = m.Override | m.Reference
TOPICS = {m.Override: topics.OVERRIDE, m.Reference: topics.REFERENCE}
ROUTER_S = 5.0
"""Seconds in which a router answers."""
AGAIN_S = 0.25
"""Seconds between two attempts."""
MOST_PERIODS = 3.0
"""Ticks of a slow loop until it reports the result of a tick."""
LAST_WORDS, APART_S = 3, 0.1
"""Number of repetitions and their interval for a message that ends a session: the control lane may drop messages."""


class Commander:
    """Publish messages, numbered within one run, and receive those of other processes.

    Args:
        bus: open.
        heard: the topics that it receives.
    """

    def __init__(self, bus: Bus, heard: tuple[Topic, ...]):
        self._bus, self._seq = bus, 0
        self._heard = {topic.name: topic for topic in heard}
        self._mailbox = bus.everything() if heard else None

    @property
    def run_id(self) -> str:
        """Identifies the sender to other processes."""
        return self._bus.run_id

    def say(self, word: Word, again: bool = False) -> None:
        """Publish once; run_id and seq are filled in here.

        again: repeat the number of the last message, so that receivers do not take it for another one.
        """
        if again:
            self._seq = max(0, self._seq - 1)
        self._bus.publish(
            TOPICS[type(word)], msgspec.structs.replace(word, run_id=self.run_id, seq=self._seq)
        )
        self._seq += 1

    def say_last(self, word: Word) -> None:
        """Publish a message that ends a session: several times, at short intervals."""
        for i in range(LAST_WORDS):
            self.say(word, again=i > 0)
            clock.sleep_until(clock.now() + APART_S)

    def hear(self, seconds: float) -> m.Message | None:
        """Return the next message; None: there was none for so long. Unreadable messages are skipped."""
        assert self._mailbox is not None
        until = clock.now() + seconds
        while (left := until - clock.now()) > 0.0:
            delivery = self._mailbox.get(left)
            topic = None if delivery is None else topics.topic_of(delivery.key)
            if delivery is None or topic is None or topic.name not in self._heard:
                continue
            try:
                return codec.decode(topic, delivery.payload)
            except codec.BadMessage:
                continue
        return None

    def hear_until(self, done: Callable[[m.Message], bool], seconds: float) -> bool:
        """Receive until `done`, called with every message, returns True; return False after so many seconds."""
        until = clock.now() + seconds
        while (left := until - clock.now()) > 0.0:
            heard = self.hear(left)
            if heard is not None and done(heard):
                return True
        return False

    def keep_saying(
        self, word: Word, every: float, seconds: float, done: Callable[[m.Message], bool]
    ) -> bool:
        """Publish a message at an interval, in seconds, until it is done.

        Args:
            word: the message.
            every: seconds between two repetitions.
            seconds: longest duration; infinite: until it is interrupted.
            done: called with every received message.

        Returns:
            Whether it was done; False after so many seconds.
        """
        until = clock.now() + seconds
        while (left := until - clock.now()) > 0.0:
            self.say(word)
            if self.hear_until(done, min(every, left)):
                return True
        return False


@contextmanager
def commanding(config: Config, *heard: Topic) -> Iterator[Commander]:
    """Open a commander on the bus of the configuration that receives these topics.

    Raises:
        Refused: no router answers.
        ConfigError: the endpoint is none, the commander's certificate cannot be used, or the router refuses it.
    """
    stop = threading.Event()
    timer = threading.Timer(ROUTER_S, stop.set)
    timer.daemon = True
    timer.start()
    bus = Bus(config, topics.COMMANDER, new_run_id(topics.COMMANDER), stop)
    try:
        bus.open()
    except OpenInterrupted as error:
        raise Refused(
            f"no router at {config.bus.endpoint} within {ROUTER_S:g} s: nothing was sent. `tandem run` has its router "
            f"there only with --set bus.endpoint={config.bus.endpoint}"
        ) from error
    finally:
        timer.cancel()
    try:
        yield Commander(bus, heard)
    finally:
        bus.close()


def ask(config: Config, reference: m.Reference, seconds: float) -> list[m.TickResult]:
    """Return the controller's answer: the results of the tick that latched the message and of the next one, if any.

    A tick that was prepared before still has the earlier target.

    Raises:
        Refused: no router answers.
        ConfigError: no link, and why.
    """
    with commanding(config, topics.RESULT) as commander:
        results: list[m.TickResult] = []

        def done(heard: m.Message) -> bool:
            if isinstance(heard, m.TickResult) and (results or heard.reference_from == commander.run_id):
                results.append(heard)
            return len(results) > 1

        every = max(AGAIN_S, MOST_PERIODS * config.period)
        commander.keep_saying(reference, every, max(seconds, every), done)
        return results
