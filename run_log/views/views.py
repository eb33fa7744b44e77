"""The interface of the views: encoded messages in, JSON for people and tools out."""

from __future__ import annotations

from typing import NamedTuple

from lbmpc.plants import Description
from node_runtime.config.sections import Config
from protocol import codec, topics
from protocol.messages import Health, RunInfo, TickResult
from run_log.views.arrival import COUNTED, LostTicks, SendTimes
from run_log.views.channel import Channel, Shown
from run_log.views.events import Events
from run_log.views.heads import head_of
from run_log.views.series import Bounds, Targets
from run_log.views.user_topics import UserView
from run_log.views.view import views

MOST_USER_TOPICS = 64
RARE = (Health, RunInfo)
"""Types of messages that all have a view, whatever the rate."""


class Seen(NamedTuple):
    """What one message shows."""

    shown: list[Shown]
    """(channel, JSON text) pairs, in this order."""
    seq: int = 0
    """The message's number; 0 where it has none."""
    sent_ns: int = 0
    """When it was sent, on the clock of its arrival; the arrival itself where it has no time of its own."""
    bad: codec.BadMessage | None = None
    """Why it has no view: it is no valid message of its topic."""


class Views:
    """Follows one run, and turns each of its messages into JSON.

    Feed it all messages in the order of their arrival. A consumer registers a `Channel` when it first comes; a channel
    with fields that were not known beforehand (counters, users' own topics) comes again as a new object of the same
    name when it has more of them.

    Args:
        config: the resolved configuration.
        plant: its names and units label the views.
        most_hz: views a second of one topic; None: as many as `Topic.view_hz` says, and `topics.VIEW_HZ` of a user's.
            Events are made of all messages.
    """

    def __init__(self, config: Config, plant: Description, most_hz: float | None = None):
        self._views = views(plant)
        self._bounds, self._targets, self._events = Bounds(config, plant), Targets(plant), Events()
        self._lost = LostTicks(config.bus.follow_silence)
        self._times = SendTimes()
        self._users: dict[str, UserView] = {}
        # Of messages that are rare the newest counts, and their events need all of them.
        self._every_ns: dict[str, int] = {
            name: 0 if view.topic.type in RARE else int(1e9 / (most_hz or view.topic.view_hz))
            for name, view in self._views.items()
        }
        self._user_every_ns = int(1e9 / (most_hz or topics.VIEW_HZ))
        self._due: dict[str, int] = {}
        """When, in ns, a topic's next view is due; what comes earlier has none."""

    @property
    def channels(self) -> list[Channel]:
        """All channels of Tandem's own, and those of users' topics so far, with their schemas as they are now."""
        own = [view.channel for view in self._views.values()]
        users = [view.channel for view in self._users.values() if view.channel is not None]
        return [*own, self._bounds.channel, self._targets.channel, self._events.channel, *users]

    @property
    def lost(self) -> dict[str, int]:
        """By topic, messages that are missing between others: they never arrived."""
        return self._lost.count

    def show(self, name: str, payload: bytes, time_ns: int) -> Seen:
        """Show one message. Never raises for what is in it.

        Args:
            name: its key below `tandem/<plant>/`: "plant/state", "user/wind".
            payload: its bytes as they travelled.
            time_ns: when it arrived; the clock of all times here.
        """
        if topics.is_user(name):
            return Seen(self._of_user(name, payload, time_ns), sent_ns=time_ns)
        topic = topics.BY_NAME.get(name)
        if topic is None:
            return Seen([], sent_ns=time_ns)
        view = self._views.get(name)
        head = head_of(name, payload) if view is None or time_ns < self._due.get(name, 0) else None
        bad: codec.BadMessage | None = None
        message = None
        # Also a message that is not due, where its head cannot be read: it is counted.
        if head is None and view is not None:
            try:
                head = message = codec.decode(topic, payload)
            except codec.BadMessage as error:
                bad = error
        if head is None:
            return Seen([], sent_ns=time_ns, bad=bad)
        shown: list[Shown] = []
        if name in COUNTED and (missing := self._lost.take(name, head.run_id, head.seq, time_ns)):
            shown += self._events.lost(name, head.seq, missing, time_ns)
        shown += self._events.take(name, head, time_ns)
        if view is not None and message is not None:
            try:
                shown.append(view.render(message))
                shown += self._beside(name, message, time_ns)
            except codec.BadMessage as error:
                bad = error
            else:
                self._wait(name, time_ns, self._every_ns[name])
        return Seen(shown, max(head.seq, 0), self._times.of(name, head, time_ns), bad)

    def _wait(self, name: str, time_ns: int, every_ns: int) -> None:
        # Where every message has a view, one that is out of order has one too.
        if every_ns:
            self._due[name] = time_ns + every_ns

    def _beside(self, name: str, message: object, time_ns: int) -> list[Shown]:
        """The series that go with a topic."""
        if name == topics.PLANT_STATE.name:
            bounds = self._bounds.show(time_ns)
            return [] if bounds is None else [bounds]
        if isinstance(message, TickResult):
            try:
                return [self._targets.show(message)]
            except ValueError as error:
                raise codec.BadMessage(name, "wrong size", str(error)) from error
        return []

    def _of_user(self, name: str, payload: bytes, time_ns: int) -> list[Shown]:
        if len(payload) > topics.USER_MAX_BYTES or time_ns < self._due.get(name, 0):
            return []
        view = self._users.get(name)
        if view is None:
            if len(self._users) >= MOST_USER_TOPICS:
                return []
            view = self._users[name] = UserView(name)
        self._wait(name, time_ns, self._user_every_ns)
        shown = view.render(payload)
        return [] if shown is None else [shown]
