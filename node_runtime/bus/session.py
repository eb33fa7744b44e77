"""Zenoh sessions as Tandem uses them: explicit endpoints, no scouting, an opening that can be interrupted."""

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
"""A reader that is silent for less than this has only been without a core; the messages wait for it meanwhile."""
OPEN_MS = 500
"""After so long those who obey give up an attempt to reach their router: on a cut link its first packet is lost, and
TCP repeats it only after a second. Another attempt is made before that, so that control is back within one."""
RETRY_MS, RETRY_SECURE_MS = 100, 1000
"""Between two attempts, at most. What is said before a recorder is back is in no log; but who is refused need not be
refused ten times a second."""
GIVE_UP_US = 1_000_000
"""For as long the router holds everybody's bulk messages back where a reader's link is full; then it cuts that link."""
ENDPOINT = re.compile(r"(tcp|tls|quic)/(\[[0-9a-fA-F:.%]+\]|[^\s:/\[\]]+):\d{1,5}([?#].*)?")


class OpenInterrupted(RuntimeError):
    """The process was told to stop while it still waited for the router."""


def session_config(
    mode: Literal["client", "router"],
    endpoint: str,
    lease_ms: int,
    remote: str | None = None,
    more: Mapping[str, Any] | None = None,
) -> zenoh.Config:
    """Zenoh's configuration: explicit endpoints, no scouting, no shared memory.

    remote: where a router listens as well; more: settings on top, for links with certificates.

    Raises:
        ConfigError: `endpoint` is not like `tcp/127.0.0.1:7447`. Zenoh itself would try it again for ever.
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
        # Messages above 3 kB vanish without an error where the receiver's memlock limit is small.
        "transport/shared_memory/enabled": False,
        # The other end takes the link for cut after this much silence, and all that is on its way here is lost then.
        "transport/link/tx/lease": lease_ms,
        "transport/link/tx/keep_alive": 4,
        # With Zenoh's two places a busy machine loses up to 3 % of the control messages: whatever is put while
        # the sending thread waits for a core. Sixteen small ones are still younger than a period.
        "transport/link/tx/queue/size/real_time": 16,
        # And with two for the rest, 100 kB, the router waits for a reader that is without a core for a moment.
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
    """Where Zenoh is to connect. For certificates it takes the brackets of an IPv6 address for a part of the name.

    Without them it finds the port behind the last colon, and compares the address with those in the certificate.

    Raises:
        ConfigError: certificates and an address with a zone, which no certificate can name.
    """
    if not secure(endpoint) or "[" not in endpoint:
        return endpoint
    if "%" in endpoint:
        raise ConfigError(
            f"bus.endpoint = {endpoint!r}: no certificate can name an address with a zone; write another address of "
            "the router, or a name, that its certificate has (`tandem keys renew --role router --host HOST`)"
        )
    protocol, _, place = endpoint.partition("/")
    return f"{protocol}/{place.replace('[', '', 1).replace(']', '', 1)}"


def secure(endpoint: str) -> bool:
    """Whether links to this endpoint need certificates."""
    return endpoint.startswith(("tls/", "quic/"))


def lease_ms(config: Config, process: str) -> int:
    """After how much silence of `process` its link counts as cut.

    Controller and plant obey each other, so a link that they are behind no more is cut soon. A reader gets no core
    while they need all of them, and to cut its link for that would lose what it should read. Both ends cut: a reader
    that runs again finds its own clock past the router's lease, so the router's is long too.
    """
    short = config.bus.lease_ms
    return short if process in OBEYING else max(short, PATIENT_LEASE_MS)


def connect(
    config: Config, stop: threading.Event, process: str, sessions: int = 1
) -> tuple[zenoh.Session, ...]:
    """Client sessions of `process` to the router at `config.bus.endpoint`; waits for the router for ever.

    Raises:
        OpenInterrupted: `stop` was set first.
        ConfigError: the endpoint is none; our certificate cannot be used; or the router and we refuse each other,
            which no waiting heals. The text says why.
    """
    tls = None
    if secure(config.bus.endpoint):
        # Only here, for a machine that needs no certificates loads nothing for them.
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
    """`zenoh.open` cannot be interrupted by a signal, so it runs in a thread that can be left behind."""
    endpoint = config.bus.endpoint
    more: Mapping[str, Any] = {"transport/unicast/open_timeout": OPEN_MS} if process in OBEYING else {}
    if tls is not None:
        # A handshake with certificates takes its time.
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
            log.warning("no router at %s yet; waiting for it (start it with `tandem router`)", endpoint)
    try:
        return result.result()
    except zenoh.ZError as error:
        raise ConfigError(f"bus.endpoint = {endpoint!r} cannot be used: {error}") from error


def _discard(opened: Future[zenoh.Session]) -> None:
    if opened.exception() is None:
        opened.result().close()
