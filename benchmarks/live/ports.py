"""Ports of this machine for runs that must not meet."""

from __future__ import annotations

import socket


def free_port() -> int:
    """One on loopback on which nobody listens at this moment."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
