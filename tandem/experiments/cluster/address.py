"""Checks the address of a scheduler, because workers run any code that they receive."""

from __future__ import annotations

import ipaddress
import socket
from urllib.parse import urlsplit

from node_runtime.config.strict import ConfigError

EXAMPLES = "tcp://127.0.0.1:8786 on this machine, tls://HOST:8786 on another one"


def checked(address: str) -> str:
    """Return the address with its protocol.

    Raises:
        ConfigError: not an address, or one beyond this machine without TLS.
    """
    full = address if "://" in address else f"tcp://{address}"
    try:
        parts = urlsplit(full)
        host, port = parts.hostname, parts.port
    except ValueError:
        host = port = None
    if parts.scheme not in ("tcp", "tls") or not host or not port or parts.path.strip("/"):
        raise ConfigError(f"--cluster {address}: not the address of a Dask scheduler; for example {EXAMPLES}")
    if parts.scheme == "tcp" and not _is_loopback(host, address):
        raise ConfigError(
            f"--cluster {address}: leaves this machine without TLS. Anyone who reaches such a scheduler can run code "
            f"on its workers. Start it with certificates and write tls://{host}:{port}, or reach it through a tunnel "
            'that ends on this machine ("Sweep on a cluster" in the documentation)'
        )
    return full


def _is_loopback(host: str, address: str) -> bool:
    try:
        found = {info[4][0] for info in socket.getaddrinfo(host, None)}
    except (OSError, UnicodeError) as error:
        raise ConfigError(f"--cluster {address}: {host} is not known here ({error})") from error
    return all(ipaddress.ip_address(str(one).partition("%")[0]).is_loopback for one in found)
