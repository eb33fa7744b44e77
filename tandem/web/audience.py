"""The connected viewers, and a bounded queue of frames for each. No I/O."""

from __future__ import annotations

import asyncio
import itertools
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from run_log.views.channel import Channel
from tandem.web import foxglove_protocol as protocol

WAITING_BYTES = 2 * 1024 * 1024
"""Bytes of messages that may wait for one viewer. Beyond that the oldest message is dropped."""


class Viewer:
    """One connected viewer: its subscriptions, and the frames that wait for it."""

    def __init__(self) -> None:
        self.subscriptions: dict[int, int] = {}
        """Channel to the viewer's own number of the subscription."""
        self.dropped = 0
        self._words: deque[str] = deque()
        self._data: deque[bytes] = deque()
        self._bytes = 0
        self._something = asyncio.Event()

    def say(self, text: str) -> None:
        """Send a text frame, before all messages that wait."""
        self._words.append(text)
        self._something.set()

    def show(self, channel: int, time_ns: int, payload: bytes) -> None:
        """Send a message of a channel if the viewer has subscribed to it."""
        subscription = self.subscriptions.get(channel)
        if subscription is None:
            return
        frame = protocol.message_data(subscription, time_ns, payload)
        self._data.append(frame)
        self._bytes += len(frame)
        while self._bytes > WAITING_BYTES and len(self._data) > 1:
            self._bytes -= len(self._data.popleft())
            self.dropped += 1
        self._something.set()

    async def next_frame(self) -> str | bytes:
        """Return the next frame to send, waiting for one."""
        while not self._words and not self._data:
            self._something.clear()
            await self._something.wait()
        if self._words:
            return self._words.popleft()
        frame = self._data.popleft()
        self._bytes -= len(frame)
        return frame


@dataclass
class _Advertised:
    """A channel as it was advertised, and its latest messages for new subscribers."""

    id: int
    channel: Channel
    kept: deque[tuple[int, bytes]]


class Audience:
    """The viewers and the channels of one server.

    Args:
        name: what a viewer shows as the source.
        session: the same for as long as this server runs.
        metadata: facts about the system, by name.
        keep: number of the latest messages of a topic that a new subscriber receives.
    """

    def __init__(self, name: str, session: str, metadata: dict[str, str], keep: Callable[[str], int]):
        self._greeting = protocol.server_info(name, session, metadata)
        self._keep = keep
        self._by_topic: dict[str, _Advertised] = {}
        self._by_id: dict[int, _Advertised] = {}
        self._ids = itertools.count(1)
        self.viewers: set[Viewer] = set()

    def advertise(self, channel: Channel) -> _Advertised:
        """Make a channel known to all viewers. It replaces a channel of the same topic that has other fields."""
        before = self._by_topic.get(channel.topic)
        if before is not None and before.channel is channel:
            return before
        kept = deque[tuple[int, bytes]](maxlen=self._keep(channel.topic)) if before is None else before.kept
        now = _Advertised(next(self._ids), channel, kept)
        self._by_topic[channel.topic] = self._by_id[now.id] = now
        if before is not None:
            del self._by_id[before.id]
        for viewer in self.viewers:
            if before is not None:
                viewer.subscriptions.pop(before.id, None)
                viewer.say(protocol.unadvertise([before.id]))
            viewer.say(protocol.advertise([(now.id, channel)]))
        return now

    def publish(self, channel: Channel, time_ns: int, data: bytes) -> None:
        """Send a message to all subscribers of its channel."""
        advertised = self.advertise(channel)
        advertised.kept.append((time_ns, data))
        for viewer in self.viewers:
            viewer.show(advertised.id, time_ns, data)

    def enter(self) -> Viewer:
        """Add a viewer, and tell it about the server and all channels."""
        viewer = Viewer()
        viewer.say(self._greeting)
        viewer.say(protocol.advertise((one.id, one.channel) for one in self._by_id.values()))
        self.viewers.add(viewer)
        return viewer

    def leave(self, viewer: Viewer) -> None:
        """Remove a viewer."""
        self.viewers.discard(viewer)

    def obey(self, viewer: Viewer, text: str | bytes) -> None:
        """Carry out a request of a viewer, or answer that it is not offered."""
        if isinstance(text, bytes):
            viewer.say(
                protocol.refusal("this server accepts no messages: it shows a bus and publishes nothing")
            )
            return
        try:
            request = protocol.request_of(text)
        except ValueError as error:
            viewer.say(protocol.refusal(f"invalid request: {error}"))
            return
        match request:
            case protocol.Subscribe(subscriptions=wanted):
                self._subscribe(viewer, wanted)
            case protocol.Unsubscribe(subscriptionIds=ids):
                kept = {c: s for c, s in viewer.subscriptions.items() if s not in ids}
                viewer.subscriptions = kept
            case protocol.Unknown(op=op):
                viewer.say(
                    protocol.refusal(
                        f"{op[:40]!r} is not offered: this server shows a bus and publishes nothing"
                    )
                )

    def _subscribe(self, viewer: Viewer, wanted: Iterable[protocol.Subscription]) -> None:
        for one in wanted:
            advertised = self._by_id.get(one.channelId)
            if advertised is None or not 0 <= one.id < 2**32 or one.channelId in viewer.subscriptions:
                viewer.say(protocol.refusal(f"no subscription {one.id} to channel {one.channelId}"))
                continue
            viewer.subscriptions[one.channelId] = one.id
            for time_ns, payload in advertised.kept:
                viewer.show(one.channelId, time_ns, payload)
