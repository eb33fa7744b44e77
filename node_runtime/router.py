"""`tandem router`: the Zenoh router that all processes connect to.

It listens on `bus.endpoint`, and on `bus.remote` for other machines. There every client needs a certificate and has the
rights of its role (`protocol.rights`).
"""

from __future__ import annotations

import contextlib
import ipaddress
import logging
import os
import re
import threading

import zenoh

from node_runtime.bus.session import lease_ms, secure, session_config
from node_runtime.bus.zenoh_bus import Bus
from node_runtime.config.sections import Config
from node_runtime.config.strict import ConfigError
from node_runtime.health import HealthPublisher
from node_runtime.lifecycle import new_run_id, run_process
from node_runtime.provenance import run_info
from node_runtime.realtime.scheduling import punctual
from node_runtime.rejected import RejectedMessages
from node_runtime.tls import zenoh_log
from protocol import topics

log = logging.getLogger(__name__)

RECEIVING_THREADS = 32
"""Number of Zenoh's receiving threads for all links. Zenoh closes the link of a vanished client with SO_LINGER, and the
closing thread then waits up to 10 s (eclipse-zenoh/zenoh #1101, #2718). A client has two links and Zenoh two threads by
default, so the cut links of one trainer would stop all states and commands for that time after its lease."""


_CAUSES = {
    "in use": (
        "{place} is in use: another router may be running, or another program uses the port (`ss -ltnp` shows it). "
        "Stop it, or set bus.endpoint or bus.remote to another port."
    ),
    "Permission denied": (
        "the router may not listen on {place}: a port below 1024 needs a privilege (CAP_NET_BIND_SERVICE). "
        "Set bus.endpoint or bus.remote to a port from 1024 on."
    ),
    "Cannot assign requested address": (
        "the router cannot listen on {place}: this machine does not have that address. "
        "Use an address of this machine, or 0.0.0.0 for all of them."
    ),
    "lookup address information": (
        "the router cannot listen on {place}: the name is not known here. Use an address of this machine."
    ),
    "invalid port value": "{place}: a port is a number from 1 to 65535.",
}
"""Messages for a person, by the words in Zenoh's text."""


class RouterError(RuntimeError):
    """The router cannot listen. The text says where and what to do."""


def open_router(config: Config) -> zenoh.Session:
    """Open a Zenoh session in router mode at `config.bus.endpoint` and `bus.remote`; it is a context manager.

    Raises:
        RouterError: it cannot listen there.
        ConfigError: an endpoint is not valid, or the router's certificate cannot be used.
    """
    bus = config.bus
    if bus.remote and not secure(bus.remote):
        raise ConfigError(
            f"bus.remote = {bus.remote!r}: other machines need certificates; write tls/HOST:PORT"
        )
    settings = None
    if remote(config):
        from node_runtime.tls import access_control, credentials

        own = credentials.of_process(bus.tls.keys, "router", config.name)
        settings = access_control.router_settings(own, config.name)
    routing = session_config("router", bus.endpoint, lease_ms(config, "router"), bus.remote or None, settings)
    try:
        return zenoh.open(routing)
    except zenoh.ZError as error:
        raise RouterError(_why_not_listening(str(error), bus.endpoint, bus.remote)) from error


def _why_not_listening(said: str, endpoint: str, other: str | None) -> str:
    """Return the cause and the remedy, given Zenoh's text about the first endpoint that failed."""
    failed = [place for place in (endpoint, other) if place and place.partition("/")[2] in said]
    place = failed[0] if len(failed) == 1 else " or ".join(filter(None, (endpoint, other)))
    for words, text in _CAUSES.items():
        if words in said:
            return text.format(place=place)
    # The position in Zenoh's sources is removed, because it does not help the reader.
    return f"the router cannot listen on {place}: {re.sub(r' at /[^ ]*[.]rs:[0-9]+[.]?', '', said)}"


def remote(config: Config) -> bool:
    """Return whether the router of this configuration listens at an endpoint with certificates."""
    return bool(config.bus.remote) or secure(config.bus.endpoint)


def open_to_all(endpoint: str) -> bool:
    """Return whether this is a plain endpoint that other machines may reach, that is, not a loopback address."""
    protocol, _, place = endpoint.partition("/")
    host = place.rpartition(":")[0].strip("[]")
    if protocol != "tcp" or host == "localhost":
        return False
    try:
        return not ipaddress.ip_address(host.partition("%")[0]).is_loopback
    except ValueError:  # a name
        return True


def main(config: Config, stop: threading.Event | None = None) -> int:
    """Run the router until it is told to stop. Return 0; 1 if the endpoint is in use; 2 if it is not usable."""
    # Zenoh reads this variable when the first session opens; there is no other way to set it.
    os.environ.setdefault("ZENOH_RUNTIME", f"(rx: (worker_threads: {RECEIVING_THREADS}))")
    if open_to_all(config.bus.endpoint) and not config.bus.insecure:
        log.warning(
            "%s is neither encrypted nor authenticated: anyone who can reach it may command the plant. Listen on "
            "127.0.0.1, and on bus.remote for other machines, with certificates from `tandem keys create`; "
            "set bus.insecure=true if this is intended",
            config.bus.endpoint,
        )
    return run_process(lambda stopping: _route(config, stopping), stop)


def _route(config: Config, stopping: threading.Event) -> int:
    bad = RejectedMessages()
    # Every state and command passes through the router, so it must be as punctual as the loops.
    with (
        punctual(config.realtime.priority, keep_awake=config.awake) as note,
        contextlib.ExitStack() as while_listening,
    ):
        if remote(config):
            # At a thousand ticks a second, a log line per message would cost more than the messages.
            fast = config.rate > topics.BATCH_ABOVE_HZ
            filters = zenoh_log.REFUSED if fast else zenoh_log.DENIED
            while_listening.enter_context(zenoh_log.counting_refusals(bad, filters))
        try:
            while_listening.enter_context(open_router(config))
        except RouterError as error:
            log.error("%s", error)
            return 1
        log.info("router listening on %s", config.bus.endpoint)
        if config.bus.remote:
            log.info("router listening for other machines, with certificates, on %s", config.bus.remote)
        # The router's health is published through a client of the router itself.
        run_id = new_run_id("router")
        info = run_info(config, "router", run_id)
        with (
            Bus(config, "router", run_id, stopping) as bus,
            HealthPublisher(bus, info, bad.counters, note=note) as health,
        ):
            health.set("running")
            stopping.wait()
    return 0
