"""The messages that the suite received from the processes of the run itself."""

from __future__ import annotations

from typing import Any

from protocol import codec, topics
from protocol import messages as m
from protocol.topics import Topic
from verification.faults.processes.rig import Rig


class Witness:
    """Each message once; strangers' messages are left out."""

    def __init__(self, rig: Rig):
        self._rig = rig
        self._known: dict[str, list[tuple[float, Any]]] = {}

    def of(self, topic: Topic) -> list[tuple[float, Any]]:
        """(time of receipt, message), in order of arrival."""
        if topic.name not in self._known:
            found: dict[tuple[str, int], tuple[float, Any]] = {}
            for heard in self._rig.heard:
                if heard.topic != topic.name:
                    continue
                try:
                    message = codec.decode(topic, heard.payload)
                except codec.BadMessage:
                    continue
                if message.run_id.startswith(f"{topic.writer}-"):
                    found.setdefault((message.run_id, message.seq), (heard.at, message))
            self._known[topic.name] = list(found.values())
        return self._known[topic.name]

    def messages(self, topic: Topic) -> list[Any]:
        return [message for _, message in self.of(topic)]

    def health(self, process: str) -> list[tuple[float, m.Health]]:
        return self.of(topics.HEALTH[process])
