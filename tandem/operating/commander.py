"""Who says where the plant shall go, or takes it by hand: a place on the bus in the role `commander`.

With certificates that takes the commander's own. What is said travels on the control lane, where a message may be lost,
so it is said again until an answer shows that it counts, and for as long as it shall.
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
"""Seconds from one asking to the next."""
MOST_PERIODS = 3.0
"""Of a slow loop, until it says what it made of a tick."""
LAST_WORDS, APART_S = 3, 0.1
"""How often what ends something is said, and how soon again: the control lane drops what finds no room."""


class Commander:
    """Says things, each with the next number of one run, and hears what others say.

    Args:
        bus: open.
        heard: the topics that it listens to.
    """

    def __init__(self, bus: Bus, heard: tuple[Topic, ...]):
        self._bus, self._seq = bus, 0
        self._heard = {topic.name: topic for topic in heard}
        self._mailbox = bus.everything() if heard else None

    @property
    def run_id(self) -> str:
        """By which others know who said it."""
        return self._bus.run_id

    def say(self, word: Word, again: bool = False) -> None:
        """Once; its run_id and seq are put in here.

        again: by the number of what was said last, for who must not take it for another word.
        """
        if again:
            self._seq = max(0, self._seq - 1)
        self._bus.publish(
            TOPICS[type(word)], msgspec.structs.replace(word, run_id=self.run_id, seq=self._seq)
        )
        self._seq += 1

    def say_last(self, word: Word) -> None:
        """What ends something: more than once, in little time."""
        for i in range(LAST_WORDS):
            self.say(word, again=i > 0)
            clock.sleep_until(clock.now() + APART_S)

    def hear(self, seconds: float) -> m.Message | None:
        """The next of what it listens to; None: there was none for so long. What cannot be read is not heard."""
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
        """Listen until it is done, which is asked of everything that is heard; False after so many seconds."""
        until = clock.now() + seconds
        while (left := until - clock.now()) > 0.0:
            heard = self.hear(left)
            if heard is not None and done(heard):
                return True
        return False

    def keep_saying(
        self, word: Word, every: float, seconds: float, done: Callable[[m.Message], bool]
    ) -> bool:
        """Say it every so often, in seconds, until it is done.

        Args:
            word: what is said.
            every: seconds from one time to the next.
            seconds: for how long; infinite: until it is interrupted.
            done: asked of everything that is heard meanwhile.

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
    """A commander on the bus of the configuration, who listens to these topics.

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
            f"no router at {config.bus.endpoint} within {ROUTER_S:g} s: nothing was said. `tandem run` has its router "
            f"there only with --set bus.endpoint={config.bus.endpoint}"
        ) from error
    finally:
        timer.cancel()
    try:
        yield Commander(bus, heard)
    finally:
        bus.close()


def ask(config: Config, reference: m.Reference, seconds: float) -> list[m.TickResult]:
    """What the controller made of it: the result of the tick that latched it, and of the next; none: no answer.

    A tick that was prepared in the time before it still aims where it aimed then.

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
