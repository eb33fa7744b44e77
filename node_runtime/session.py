"""Zenoh sessions as Tandem uses them: explicit endpoints, no scouting, an opening that can be interrupted."""

from __future__ import annotations

import json
import logging
import re
import threading
from concurrent.futures import Future
from concurrent.futures import wait as wait_for
from typing import Any, Literal

import zenoh

from node_runtime import clock
from node_runtime.config import Config, ConfigError

log = logging.getLogger(__name__)

ENDPOINT = re.compile(r"(tcp|tls|quic)/(\[[0-9a-fA-F:.%]+\]|[^\s:/\[\]]+):\d{1,5}([?#].*)?")


class OpenInterrupted(RuntimeError):
    """The process was told to stop while it still waited for the router."""


def session_config(mode: Literal["client", "router"], endpoint: str, lease_ms: int) -> zenoh.Config:
    """Zenoh's configuration: an explicit endpoint, no scouting, no shared memory.

    Raises:
        ConfigError: `endpoint` is not like `tcp/127.0.0.1:7447`. Zenoh itself would try it again for ever.
    """
    if not ENDPOINT.fullmatch(endpoint):
        raise ConfigError(
            f"bus.endpoint = {endpoint!r} is not an endpoint; write tcp/HOST:PORT, or tls/ or quic/ for tcp/"
        )
    settings: dict[str, Any] = {
        "mode": mode,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        # Messages above 3 kB vanish without an error where the receiver's memlock limit is small.
        "transport/shared_memory/enabled": False,
        # A frozen process or a cut link is noticed after the lease; the default is 10 s.
        "transport/link/tx/lease": lease_ms,
        "transport/link/tx/keep_alive": 4,
        # With Zenoh's two places a busy machine loses up to 3 % of the control messages: whatever is put while
        # the sending thread waits for a core. Sixteen small ones are still younger than a period.
        "transport/link/tx/queue/size/real_time": 16,
    }
    if mode == "client":
        settings |= {
            "listen/endpoints": [],
            "connect/endpoints": [endpoint],
            "connect/timeout_ms": -1,
            "connect/retry": {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 2.0},
        }
    else:
        settings |= {"listen/endpoints": [endpoint], "connect/endpoints": [], "listen/exit_on_failure": True}
    config = zenoh.Config()
    for key, value in settings.items():
        try:
            config.insert_json5(key, json.dumps(value))
        except zenoh.ZError as error:
            raise ConfigError(f"bus.endpoint = {endpoint!r} cannot be used: {error}") from error
    return config


def connect(config: Config, stop: threading.Event) -> zenoh.Session:
    """A client session to the router at `config.bus.endpoint`; waits for the router for ever.

    `zenoh.open` cannot be interrupted by a signal, so it runs in a thread that can be left behind.

    Raises:
        OpenInterrupted: `stop` was set first.
        ConfigError: the endpoint is none.
    """
    endpoint = config.bus.endpoint
    client = session_config("client", endpoint, config.bus.lease_ms)
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
