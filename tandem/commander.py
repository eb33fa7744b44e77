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

ROUTER_S = 5.0
"""Seconds in which a router answers."""


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

    def say(self, topic: Topic, message: m.Message) -> None:
        """Once; its run_id and seq are put in here."""
        self._bus.publish(topic, msgspec.structs.replace(message, run_id=self.run_id, seq=self._seq))
        self._seq += 1

    def say_again(self, topic: Topic, message: m.Message) -> None:
        """Once more, by the number of what was said last: for who must not take it for another word."""
        self._seq = max(0, self._seq - 1)
        self.say(topic, message)

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

    def keep_saying(
        self,
        topic: Topic,
        message: m.Message,
        every: float,
        seconds: float,
        done: Callable[[m.Message], bool],
    ) -> bool:
        """Say it every so often, in seconds, until it is done.

        Args:
            topic: of the message.
            message: what is said.
            every: seconds from one time to the next.
            seconds: for how long; infinite: until it is interrupted.
            done: asked of everything that is heard meanwhile.

        Returns:
            Whether it was done; False after so many seconds.
        """
        until = clock.now() + seconds
        while (now := clock.now()) < until:
            self.say(topic, message)
            due = min(now + every, until)
            while (left := due - clock.now()) > 0.0:
                heard = self.hear(left)
                if heard is not None and done(heard):
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
