"""Helpers of tests with real processes at a real router on loopback: free ports, processes, waiting for messages.

Other tests run at the same time, and the machine may pause a process. So these tests wait for events that must occur,
and compare the order and the time stamps of messages. Durations are measured by `make faults` and `make bench`. A time
limit only ends a hang.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from typing import get_args

from node_runtime.bus.zenoh_bus import Bus, Mailbox
from node_runtime.config.loading import override, to_json
from node_runtime.config.sections import Config
from node_runtime.realtime import clock
from protocol import codec
from protocol import messages as m
from protocol.topics import Lane, Topic, topic_of

PROGRAM = (
    "import logging, sys; logging.basicConfig(format='%(message)s', level='INFO');"
    "from node_runtime.config.loading import from_json; from {module} import main;"
    "sys.exit(main(from_json(sys.argv[1])))"
)


PORTS = itertools.cycle(range(10_000 + 150 * (os.getpid() % 150), 32_500))
"""Ports below those that the system assigns. Parallel test processes begin at different ports, so no other test takes a
port between the check and the start of its router, or while its router restarts."""


def free_endpoint() -> str:
    """Return a loopback endpoint without a listener that no other test will use soon."""
    for port in PORTS:
        with socket.socket() as probe, contextlib.suppress(OSError):
            # As routers do: a closed link that still holds the port does not count as a listener.
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(("127.0.0.1", port))
            return f"tcp/127.0.0.1:{port}"
    raise AssertionError("PORTS never ends")


def live_config(*assignments: str) -> Config:
    """Defaults on a free port, at ordinary priority, with `section.key=value` assignments.

    A link is cut only after half a minute of silence, because a process without processor time sends nothing.
    """
    patient = "bus.lease_ms=30000"
    return override(
        Config(), [f'bus.endpoint="{free_endpoint()}"', "realtime.priority=0", patient, *assignments]
    )


HANG_S = 120.0
"""Longest wait, in seconds, for an event that must occur."""


class Process:
    """One node in a separate process, which ends with the block."""

    def __init__(self, module: str, config: Config):
        self._popen = subprocess.Popen(
            [sys.executable, "-c", PROGRAM.format(module=module), to_json(config)],
            stderr=subprocess.PIPE,
            text=True,
        )
        self.said = ""

    def signal(self, number: signal.Signals) -> None:
        self._popen.send_signal(number)

    def lines(self) -> Iterator[str]:
        """Read the output of the process line by line while it runs."""
        assert self._popen.stderr is not None
        return iter(self._popen.stderr)

    def end(self, timeout_s: float = HANG_S) -> int:
        """Wait for the end; return the exit code. Afterwards `said` contains the output."""
        _, self.said = self._popen.communicate(timeout=timeout_s)
        return self._popen.returncode

    def __enter__(self) -> Process:
        return self

    def __exit__(self, *_: object) -> None:
        if self._popen.poll() is None:
            self._popen.kill()
            self._popen.communicate()


def matched(bus: Bus, topic: Topic) -> bool:
    """Whether this topic has a subscriber. Messages sent before that are not received."""
    return bus._publisher(topic).matching_status.matching


def connected(bus: Bus) -> bool:
    """Whether both lanes are connected to the router now."""
    return all(list(bus._lanes.session(lane).info.routers_zid()) for lane in get_args(Lane))


class BusListener:
    """Keeps every received message, in order of arrival."""

    def __init__(self, bus: Bus):
        self._mailbox: Mailbox = bus.everything()
        self.heard: list[tuple[str, m.Message]] = []

    def listen(self, timeout_s: float = 0.0) -> m.Message | None:
        """Receive one more valid message of a known topic."""
        while (delivery := self._mailbox.get(timeout_s)) is not None:
            topic = topic_of(delivery.key)
            if topic is None:
                continue
            try:
                message = codec.decode(topic, delivery.payload)
            except codec.BadMessage:
                continue
            self.heard.append((topic.name, message))
            return message
        return None

    def until(self, wanted: Callable[[m.Message], bool], timeout_s: float = HANG_S) -> m.Message:
        """Receive until a message satisfies the condition."""
        deadline = clock.now() + timeout_s
        while (remaining := deadline - clock.now()) > 0.0:
            message = self.listen(remaining)
            if message is not None and wanted(message):
                return message
        raise AssertionError(f"not heard within {timeout_s} s, but {len(self.heard)} other messages")

    def of(self, topic: Topic) -> list:
        """Return all messages of one topic so far."""
        while self.listen() is not None:
            pass
        return [message for name, message in self.heard if name == topic.name]


def health_of(process: str, **expected: object) -> Callable[[m.Message], bool]:
    """Return a condition: a `Health` of that process with these fields."""

    def wanted(message: m.Message) -> bool:
        return (
            isinstance(message, m.Health)
            and message.process == process
            and all(getattr(message, name) == value for name, value in expected.items())
        )

    return wanted


def wait_for(condition: Callable[[], bool], timeout_s: float = HANG_S, every: float = 0.005) -> None:
    """Wait until a condition holds, and check it at this interval in seconds."""
    deadline = clock.now() + timeout_s
    while not condition():
        assert clock.now() < deadline, f"not so within {timeout_s} s"
        clock.sleep_until(clock.now() + every)
