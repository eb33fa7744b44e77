"""A trainer's queries to its plant's controller, one at a time, without blocking its thread."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from typing import TypeVar

from node_runtime.bus.zenoh_bus import Bus
from protocol import codec, topics
from protocol import messages as m
from protocol.topics import Topic

TIMEOUT_S = 2.0
"""Seconds after which a query counts as unanswered."""

# Answers are checked like messages of a topic.
HIDDEN_ANSWER = Topic(topics.HIDDEN_QUERY, m.HiddenSnapshot, "bulk", "controller", topics.WEIGHTS_LIMIT)
SAMPLES_ANSWER = Topic(topics.OUTBOX_QUERY, m.Samples, "bulk", "controller", topics.SAMPLES.max_bytes)

_Answer = TypeVar("_Answer", m.HiddenSnapshot, m.Samples)


class Questions:
    """Sends queries, at most one at a time.

    Args:
        bus: the plant's bus.
        askers: runs the threads that wait for answers, so that a silent controller delays no other plant.
    """

    def __init__(self, bus: Bus, askers: Executor):
        self._bus, self._askers = bus, askers
        self._asked: tuple[Future[list[bytes]], Callable[[list[bytes]], None]] | None = None

    @property
    def open(self) -> bool:
        """Whether a query is not settled yet."""
        return self._asked is not None

    def ask_hidden(self, then: Callable[[Iterator[m.HiddenSnapshot]], None]) -> None:
        """Query for the hidden layers in use. `settle` passes the answers to `then`, none if there were none."""
        self._ask(
            topics.HIDDEN_QUERY, {}, lambda found: then(self._decoded(HIDDEN_ANSWER, found, m.HiddenSnapshot))
        )

    def ask_samples(
        self, run_id: str, since: int, most: int, then: Callable[[Iterator[m.Samples]], None]
    ) -> None:
        """Query for the samples of a run after number `since`, limited to the newest `most`; `then` as above."""
        parameters = {"run": run_id, "since": str(since), "last": str(most)}
        self._ask(
            topics.OUTBOX_QUERY,
            parameters,
            lambda found: then(self._decoded(SAMPLES_ANSWER, found, m.Samples)),
        )

    def settle(self) -> bool:
        """Pass on the answers to the open query if they have arrived; return whether they had."""
        if self._asked is None or not self._asked[0].done():
            return False
        (answers, then), self._asked = self._asked, None
        then(answers.result())
        return True

    def _ask(self, name: str, parameters: dict[str, str], then: Callable[[list[bytes]], None]) -> None:
        self._asked = self._askers.submit(self._bus.ask, name, parameters, TIMEOUT_S), then

    def _decoded(self, topic: Topic, payloads: list[bytes], kind: type[_Answer]) -> Iterator[_Answer]:
        for payload in payloads:
            try:
                answer = codec.decode(topic, payload)
            except codec.BadMessage as error:
                self._bus.bad.count(error.topic, error.reason, error.detail)
                continue
            assert isinstance(answer, kind)
            yield answer
