"""Zenoh sessions with explicit endpoints, without scouting, whose opening can be interrupted."""

from __future__ import annotations

import json
import logging
import re
import threading
from collections.abc import Mapping
from concurrent.futures import Future
from concurrent.futures import wait as wait_for
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any, Literal

import zenoh

from node_runtime.config.sections import Config
from node_runtime.config.strict import ConfigError
from node_runtime.realtime import clock

if TYPE_CHECKING:
    from node_runtime.tls.client import TlsClient

log = logging.getLogger(__name__)

OBEYING = ("controller", "plant")
PATIENT_LEASE_MS = 10_000
"""A reader that is silent for less than this is waiting for a core. Its messages are kept meanwhile."""
OPEN_MS = 500
"""Time limit of an attempt to reach the router for the processes in a control loop. On a cut link the first packet is
lost, and TCP repeats it only after a second. A new attempt before that restores control within a second."""
RETRY_MS, RETRY_SECURE_MS = 100, 1000
"""Longest pause between two attempts. Messages sent before the recorder is connected are not logged, so the pause is
short. A refused process need not try ten times a second, so the pause with certificates is longer."""
GIVE_UP_US = 1_000_000
"""Time for which the router holds back all bulk messages for a full link of one reader; then it closes that link."""
ENDPOINT = re.compile(r"(tcp|tls|quic)/(\[[0-9a-fA-F:.%]+\]|[^\s:/\[\]]+):\d{1,5}([?#].*)?")


class OpenInterrupted(RuntimeError):
    """The process was told to stop while it waited for the router."""


def session_config(
    mode: Literal["client", "router"],
    endpoint: str,
    lease_ms: int,
    remote: str | None = None,
    more: Mapping[str, Any] | None = None,
) -> zenoh.Config:
    """Return Zenoh's configuration: explicit endpoints, no scouting, no shared memory.

    Args:
        mode: of the session.
        endpoint: address to connect to, or of a router to listen at.
        lease_ms: silence after which a link counts as cut.
        remote: a second address for a router to listen at.
        more: additional settings, for links with certificates.

    Raises:
        ConfigError: an endpoint is not like `tcp/127.0.0.1:7447`. Zenoh itself would retry it without end.
    """
    for key, place in (("endpoint", endpoint), ("remote", remote)):
        if place is not None and not ENDPOINT.fullmatch(place):
            raise ConfigError(
                f"bus.{key} = {place!r} is not an endpoint; write tcp/HOST:PORT, or tls/ or quic/ for tcp/"
            )
    settings: dict[str, Any] = {
        "mode": mode,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        # With a small memlock limit at the receiver, messages above 3 kB would be lost without an error.
        "transport/shared_memory/enabled": False,
        # The peer closes the link after this silence, and messages on their way are lost then.
        "transport/link/tx/lease": lease_ms,
        "transport/link/tx/keep_alive": 4,
        # With Zenoh's default of two slots a busy machine loses up to 3 % of the control messages, those published
        # while the sending thread waits for a core. Sixteen small messages are still younger than a period.
        "transport/link/tx/queue/size/real_time": 16,
        # With two slots for bulk, 100 kB, the router would wait for a reader that has no core for a moment.
        "transport/link/tx/queue/size/data": 16,
    }
    if mode == "client":
        settings |= {
            "listen/endpoints": [],
            "connect/endpoints": [_place(endpoint)],
            "connect/timeout_ms": -1,
            "connect/retry": {
                "period_init_ms": RETRY_MS,
                "period_max_ms": RETRY_SECURE_MS if secure(endpoint) else RETRY_MS,
                "period_increase_factor": 2.0,
            },
        }
    else:
        settings |= {
            "listen/endpoints": [endpoint] if remote is None else [endpoint, remote],
            "connect/endpoints": [],
            "listen/exit_on_failure": True,
            "transport/link/tx/queue/congestion_control/block/wait_before_close": GIVE_UP_US,
        }
    config = zenoh.Config()
    for key, value in (settings | dict(more or {})).items():
        try:
            config.insert_json5(key, json.dumps(value))
        except zenoh.ZError as error:
            raise ConfigError(f"bus.endpoint = {endpoint!r} cannot be used: {error}") from error
    return config


def _place(endpoint: str) -> str:
    """Return the address that Zenoh connects to.

    With certificates Zenoh takes the brackets of an IPv6 address as part of the name. Without them it finds the port
    after the last colon and compares the address with those in the certificate.

    Raises:
        ConfigError: an address with a zone is used with certificates, which cannot contain one.
    """
    if not secure(endpoint) or "[" not in endpoint:
        return endpoint
    if "%" in endpoint:
        raise ConfigError(
            f"bus.endpoint = {endpoint!r}: a certificate cannot contain an address with a zone; use another address or "
            "a name of the router that its certificate contains (`tandem keys renew --role router --host HOST`)"
        )
    protocol, _, place = endpoint.partition("/")
    return f"{protocol}/{place.replace('[', '', 1).replace(']', '', 1)}"


def secure(endpoint: str) -> bool:
    """Return whether links to this endpoint need certificates."""
    return endpoint.startswith(("tls/", "quic/"))


def lease_ms(config: Config, process: str) -> int:
    """Return the silence in milliseconds after which a link of `process` counts as cut.

    Controller and plant control each other, so their links are cut soon. A reader may have no core while they need all
    of them, and closing its link would lose messages. Both ends apply the lease: a reader that runs again compares its
    clock with the router's lease, so the router's lease is long too.
    """
    short = config.bus.lease_ms
    return short if process in OBEYING else max(short, PATIENT_LEASE_MS)


def connect(
    config: Config, stop: threading.Event, process: str, sessions: int = 1
) -> tuple[zenoh.Session, ...]:
    """Open client sessions of `process` to the router at `config.bus.endpoint`, waiting without a time limit.

    Raises:
        OpenInterrupted: `stop` was set.
        ConfigError: the endpoint is not valid, our certificate cannot be used, or either side refuses the other, so
            that waiting cannot help. The text says why.
    """
    tls = None
    if secure(config.bus.endpoint):
        # Created only here, so that a machine without certificates imports nothing for them.
        from node_runtime.tls.client import TlsClient

        tls = TlsClient(config, process)
    with ExitStack() as undo:
        opened = []
        for _ in range(sessions):
            opened.append(_connect(config, stop, process, tls))
            undo.callback(opened[-1].close)
        undo.pop_all()
    if tls is not None:
        tls.watch(stop)
    return tuple(opened)


def _connect(config: Config, stop: threading.Event, process: str, tls: TlsClient | None) -> zenoh.Session:
    """Open a session in a thread that can be abandoned, because a signal cannot interrupt `zenoh.open`."""
    endpoint = config.bus.endpoint
    more: Mapping[str, Any] = {"transport/unicast/open_timeout": OPEN_MS} if process in OBEYING else {}
    if tls is not None:
        # A handshake with certificates takes longer than the short time limit.
        more = tls.settings
    client = session_config("client", endpoint, lease_ms(config, process), more=more)
    result: Future[zenoh.Session] = Future()

    def open_session() -> None:
        try:
            result.set_result(zenoh.open(client))
        except zenoh.ZError as error:
            result.set_exception(error)

    threading.Thread(target=open_session, name="connect", daemon=True).start()
    told = False
    started = clock.now()
    while not wait_for([result], timeout=0.05).done:
        if stop.is_set():
            result.add_done_callback(_discard)
            raise OpenInterrupted(f"stopped while waiting for the router at {endpoint}")
        if tls is not None and (reason := tls.refused(clock.now() - started)) is not None:
            result.add_done_callback(_discard)
            raise ConfigError(f"no link to the router at {endpoint}: {reason}")
        if not told and clock.now() - started > 2.0:
            told = True
            log.warning(
                "no router at %s yet; waiting for it. `tandem run` and `tandem router` start one", endpoint
            )
    try:
        return result.result()
    except zenoh.ZError as error:
        raise ConfigError(f"bus.endpoint = {endpoint!r} cannot be used: {error}") from error


def _discard(opened: Future[zenoh.Session]) -> None:
    if opened.exception() is None:
        opened.result().close()
