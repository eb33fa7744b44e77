"""Where the page and the socket of `tandem live` are."""

from __future__ import annotations

import socket

from node_runtime.config.sections import Config

HOST = "127.0.0.1"
"""Loopback only: every client that reaches the port may read."""


def address(config: Config) -> str:
    """Where the page is, without the protocol; the socket is at the same address."""
    return f"localhost:{config.live.port}"


def taken(config: Config) -> str:
    """Return the message for a port that is in use."""
    port = config.live.port
    return (
        f"live.port {port} is in use, perhaps by the live view of another system; choose another port: "
        f"--set live.port={port + 1}"
    )


def is_free(config: Config) -> bool:
    """Return whether the port can be listened on at this moment."""
    with socket.socket() as probe:
        # As servers do: a closed link that still holds the port is not a listener.
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, config.live.port))
        except OSError:
            return False
    return True
