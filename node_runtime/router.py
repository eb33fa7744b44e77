"""`tandem router`: the Zenoh router that all nodes are clients of.

It listens on `bus.endpoint`, and on `bus.remote` for other machines, where every client needs a certificate and may do
what its role may (`protocol.rights`).
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
"""Of Zenoh, for all links together. It closes the link of a client that has vanished with SO_LINGER, and the thread
that does waits in it for up to 10 s (eclipse-zenoh/zenoh #1101, #2718). A client has two links and Zenoh two threads:
a trainer whose link was cut stopped every state and command for that long, as soon as its lease was over."""


_CAUSES = {
    "in use": (
        "{place} is taken: another router may be running, or another program has the port (`ss -ltnp` names it). "
        "Stop it, or set bus.endpoint or bus.remote to another port."
    ),
    "Permission denied": (
        "the router may not listen on {place}: a port below 1024 needs a privilege (CAP_NET_BIND_SERVICE). "
        "Set bus.endpoint or bus.remote to a port from 1024 on."
    ),
    "Cannot assign requested address": (
        "the router cannot listen on {place}: this machine does not have that address. "
        "Write one that it has; 0.0.0.0 stands for all of them."
    ),
    "lookup address information": (
        "the router cannot listen on {place}: the name is not known here. Write an address of this machine."
    ),
    "invalid port value": "{place}: a port is a number from 1 to 65535.",
}
"""By what Zenoh says: what it means for a person."""


class RouterError(RuntimeError):
    """The router cannot listen; the text says where and what to do."""


def open_router(config: Config) -> zenoh.Session:
    """A Zenoh session in router mode, listening on `config.bus.endpoint` and `bus.remote`; a context manager.

    Raises:
        RouterError: it cannot listen there.
        ConfigError: an endpoint is none, or the router's certificate cannot be used.
    """
    bus = config.bus
    if bus.remote and not secure(bus.remote):
        raise ConfigError(
            f"bus.remote = {bus.remote!r}: other machines come in with certificates only; write tls/HOST:PORT"
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
    """The plain cause and what to do, from what Zenoh said of the first endpoint that failed."""
    failed = [place for place in (endpoint, other) if place and place.partition("/")[2] in said]
    place = failed[0] if len(failed) == 1 else " or ".join(filter(None, (endpoint, other)))
    for words, text in _CAUSES.items():
        if words in said:
            return text.format(place=place)
    # Where in Zenoh's sources it was said helps nobody.
    return f"the router cannot listen on {place}: {re.sub(r' at /[^ ]*[.]rs:[0-9]+[.]?', '', said)}"


def remote(config: Config) -> bool:
    """Whether the router of this configuration listens where certificates are needed."""
    return bool(config.bus.remote) or secure(config.bus.endpoint)


def open_to_all(endpoint: str) -> bool:
    """Whether this is a plain endpoint that may be reached from elsewhere: none of loopback."""
    protocol, _, place = endpoint.partition("/")
    host = place.rpartition(":")[0].strip("[]")
    if protocol != "tcp" or host == "localhost":
        return False
    try:
        return not ipaddress.ip_address(host.partition("%")[0]).is_loopback
    except ValueError:  # a name
        return True


def main(config: Config, stop: threading.Event | None = None) -> int:
    """`tandem router`: route until told to stop. 0; 1 when the endpoint is taken; 2 when it cannot be used."""
    # Read when the first session opens, and nowhere else to be said.
    os.environ.setdefault("ZENOH_RUNTIME", f"(rx: (worker_threads: {RECEIVING_THREADS}))")
    if open_to_all(config.bus.endpoint) and not config.bus.insecure:
        log.warning(
            "%s is neither encrypted nor authenticated: whoever reaches it may command the plant. Let it listen on "
            "127.0.0.1, and on bus.remote for other machines, with certificates that `tandem keys create` makes; "
            "bus.insecure=true says that it is meant",
            config.bus.endpoint,
        )
    return run_process(lambda stopping: _route(config, stopping), stop)


def _route(config: Config, stopping: threading.Event) -> int:
    bad = RejectedMessages()
    # Every state and every command passes through here, so the router must be as punctual as the loops.
    with (
        punctual(config.realtime.priority, keep_awake=config.awake) as note,
        contextlib.ExitStack() as while_listening,
    ):
        if remote(config):
            # At a thousand ticks a second a line of log for each message would cost more than the messages.
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
            log.info("and for other machines, with certificates, on %s", config.bus.remote)
        # Its health travels like everybody else's, through a client of itself.
        run_id = new_run_id("router")
        info = run_info(config, "router", run_id)
        with (
            Bus(config, "router", run_id, stopping) as bus,
            HealthPublisher(bus, info, bad.counters, note=note) as health,
        ):
            health.set("running")
            stopping.wait()
    return 0
